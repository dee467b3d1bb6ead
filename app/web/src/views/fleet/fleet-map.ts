/** What the view draws on the map: robots, the route of the selected one, closures; and what a tap on them selects. */
import { computed, effect, type Signal, signal } from "@preact/signals";
import { go, param } from "../../address";
import type { FeatureLayer } from "../../map/feature-layer";
import { type Feature, FeatureIndex, linesOf, type Position } from "../../map/features";
import { MenuPress } from "../../map/menu-press";
import type { SiteMap } from "../../map/site-map";
import { can } from "../../session";
import { colour, theme } from "../../theme";
import { closuresOf, featuresOf } from "./closures";
import { type Marker, RobotLayer } from "./robot-layer";
import { standingOf } from "./status";
import { type FleetStore, now } from "./store";
import type { Overlay, Robot } from "./types";

const ROBOT_PIXELS = 18;
const TOUCH_PIXELS = 26;
const MAX_TICKING = 200;
const MANY = 100;
const PAUSE = 400;

export class FleetMap {
  /** Features of the version by id: the edges and nodes that closures and robots name. */
  readonly byId = computed(() => new Map(this.map.site.features.value.map((feature) => [feature.id, feature])));
  /** Closures of another time, in place of those now. */
  readonly past: Signal<Overlay[] | null> = signal(null);
  /** Whether robots are drawn: not over the map of another time. */
  readonly showsRobots = computed(() => !param("time"));
  /** Takes taps and drags while something is drawn. Returns whether it did. */
  onTap: ((feature: Feature | null, point: Position) => void) | null = null;
  private index = new FeatureIndex([]);
  private painting = 0;
  private paintedAt = 0;
  private readonly robots: RobotLayer;
  private readonly route: FeatureLayer;
  private readonly closures: FeatureLayer;
  private readonly drawn: FeatureLayer;
  private readonly menu: MenuPress;
  private readonly stops: (() => void)[];

  constructor(
    readonly map: SiteMap,
    readonly store: FleetStore,
  ) {
    this.route = map.addLayer({ classOf: () => "route", paints: routePaints }, 21);
    this.closures = map.addLayer({ classOf: ({ properties }) => String(properties.class), paints: closurePaints }, 22);
    this.drawn = map.addLayer({ classOf: () => "drawn", paints: drawnPaints }, 24);
    this.robots = new RobotLayer({ zIndex: 23 });
    map.map.addLayer(this.robots);
    this.menu = new MenuPress(map.map.getViewport() as HTMLElement, (event) => this.closeStreet(event));
    this.stops = [
      map.takePicks((feature, point, event) => this.pick(feature, point, event)),
      () => this.menu.close(),
      effect(() => this.showRobots()),
      effect(() => this.showClosures()),
      effect(() => this.showRoute()),
    ];
  }

  close(): void {
    for (const stop of this.stops) stop();
    clearTimeout(this.painting);
    for (const layer of [this.route, this.closures, this.drawn]) this.map.removeLayer(layer);
    this.map.map.removeLayer(this.robots);
    this.robots.dispose();
  }

  /** Shows what is being drawn. */
  draw(features: readonly Feature[]): void {
    this.drawn.setFeatures(features);
  }

  /** Where a robot is: its pose, else its node. Null: unknown, or on another level. */
  placeOf(robot: Robot): { at: Position; yaw: number | null; level: string | null } | null {
    const place = robot.place;
    if (place?.pose) return { at: [place.pose.x, place.pose.y], yaw: place.pose.yaw, level: place.pose.level };
    const node = place?.node ? this.byId.value.get(place.node) : undefined;
    if (node?.geometry.type !== "Point") return null;
    const [x = 0, y = 0] = node.geometry.coordinates;
    return { at: [x, y], yaw: null, level: node.level };
  }

  /** Moves the map to a robot. */
  reveal(robot: Robot): void {
    const place = this.placeOf(robot);
    if (!place) return;
    if (place.level && place.level !== this.map.site.level.peek()) go({ level: place.level }, { replace: true });
    const [x, y] = place.at;
    const view = this.map.map.getView();
    const [a = 0, b = 0, c = 0, d = 0] = view.calculateExtent(this.map.map.getSize());
    const isSeen = x > a && y > b && x < c && y < d;
    if (!isSeen || (view.getResolution() ?? 1) > 0.5) this.map.fit([x - 15, y - 15, x + 15, y + 15]);
  }

  private pick(feature: Feature | null, point: Position, event: MouseEvent | PointerEvent): boolean {
    if (this.menu.isOpened) return true;
    if (this.onTap) {
      this.onTap(feature, point);
      return true;
    }
    const isTouch = (event as PointerEvent).pointerType === "touch";
    const pixel = this.map.resolution.peek();
    const robot = this.robots.near(point, (isTouch ? TOUCH_PIXELS : ROBOT_PIXELS) * pixel);
    if (robot) {
      go({ robot, closure: null, fleet: "robots" });
      return true;
    }
    const closure = this.index.near(point, (isTouch ? TOUCH_PIXELS : 10) * pixel)[0];
    if (closure && !this.past.peek()) {
      go({ closure: closure.id, robot: null, fleet: "closures" });
      return true;
    }
    return false;
  }

  /** A right click or long press on a street starts closing it. */
  private closeStreet(event: MouseEvent): void {
    const edge = can("editor") && !this.onTap && this.map.pick(this.map.positionOf(event), 16).find(isEdge);
    if (!edge) return;
    event.preventDefault();
    go({ fleet: "closures", close: "street", edge: edge.id, closure: null, robot: null });
  }

  private showRobots(): void {
    this.store.round.value;
    theme.value;
    const chosen = param("robot");
    const level = this.map.site.level.value;
    const markers: Marker[] = [];
    if (this.showsRobots.value) {
      for (const robot of this.store.all()) {
        const place = this.placeOf(robot);
        if (!place || (place.level && place.level !== level)) continue;
        markers.push({
          robot: robot.robot,
          at: place.at,
          yaw: place.yaw,
          standing: standingOf(robot),
          isSelected: robot.robot === chosen,
        });
      }
    }
    this.paintLater(markers);
  }

  /** Paints a big fleet a few times a second only: all of it is drawn each time. */
  private paintLater(markers: readonly Marker[]): void {
    clearTimeout(this.painting);
    const pause = markers.length > MANY ? PAUSE - (performance.now() - this.paintedAt) : 0;
    const paint = () => {
      this.paintedAt = performance.now();
      this.robots.setMarkers(markers);
    };
    if (pause > 0) this.painting = window.setTimeout(paint, pause);
    else paint();
  }

  private showClosures(): void {
    theme.value;
    const past = this.past.value;
    const shown = past ?? this.store.overlays.value.filter(({ state }) => state === "pending" || state === "accepted");
    const chosen = param("closure");
    const level = this.map.site.level.value;
    const time = past ? null : shown.length > MAX_TICKING ? now.peek() : now.value;
    const features = featuresOf(closuresOf(shown, this.byId.value), this.byId.value, this.map.site.frame.value, time)
      .filter((feature) => feature.level === level || !feature.level)
      .map((feature) => ({
        ...feature,
        properties: {
          ...feature.properties,
          class: `${past ? "accepted" : feature.properties.state}${feature.id === chosen ? "-chosen" : ""}`,
        },
      }));
    this.index = new FeatureIndex(features);
    this.closures.setFeatures(features);
  }

  private showRoute(): void {
    const name = this.showsRobots.value ? param("robot") : null;
    this.store.names.value;
    const place = name ? this.store.robot(name)?.value.place : null;
    const ids = [...(place?.route ?? []), ...(place?.node ? [place.node] : [])];
    this.route.setFeatures(ids.flatMap((id) => this.byId.value.get(id) ?? []));
  }
}

/** Whether a feature is a street that can be closed. */
export function isEdge(feature: Feature): boolean {
  return feature.layer === "topology" && linesOf(feature.geometry).length > 0;
}

function routePaints() {
  return { route: { stroke: `color-mix(in srgb, ${colour("robot")} 70%, transparent)`, width: 6, dot: 10 } };
}

function closurePaints() {
  const stroke = colour("closure");
  const fill = (share: number) => `color-mix(in srgb, ${stroke} ${share}%, transparent)`;
  return {
    pending: { stroke, width: 4, dash: [7, 6], fill: fill(10), labels: true },
    accepted: { stroke, width: 5, fill: fill(28), labels: true },
    "pending-chosen": { stroke, width: 8, dash: [7, 6], fill: fill(24), labels: true },
    "accepted-chosen": { stroke, width: 9, fill: fill(40), labels: true },
  };
}

function drawnPaints() {
  const stroke = colour("accent");
  return {
    drawn: { stroke, width: 4, fill: `color-mix(in srgb, ${stroke} 22%, transparent)`, dot: 9, labels: true },
  };
}
