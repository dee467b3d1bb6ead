/** What a change takes from robots, on the map. */
import type { Schemas } from "../../api/client";
import type { FeatureLayer } from "../../map/feature-layer";
import { centreOf, type Feature, type Geometry, type Position } from "../../map/features";
import type { SiteMap } from "../../map/site-map";
import { colour } from "../../theme";
import { type Change, stateOf } from "../../map/changes";

type Impact = Schemas["ImpactOut"];

const Z = 21;

export class ImpactMap {
  private readonly layer: FeatureLayer;

  constructor(private readonly map: SiteMap) {
    this.layer = map.addLayer(
      {
        classOf: (feature) => String(feature.properties.class),
        paints: () => ({
          cut: { stroke: colour("deleted"), sign: "ring", labels: true },
          deleted: { stroke: colour("deleted"), width: 3, dash: [7, 5], sign: "cross" },
          turned: { stroke: colour("changed"), width: 3.5, arrows: true, sign: "triangle" },
          blocked: { stroke: colour("keepout"), width: 4, sign: "square" },
          clear: { stroke: colour("robot"), dot: 9, labels: true },
          touched: { stroke: colour("robot"), dot: 9, sign: "triangle", labels: true },
        }),
      },
      Z,
    );
  }

  close(): void {
    this.map.removeLayer(this.layer);
  }

  repaint(): void {
    this.layer.repaint();
  }

  show(features: readonly Feature[], level: string): void {
    this.layer.setFeatures(features.filter((feature) => feature.level === level));
  }
}

/** Features to draw for an impact. known: features of the newer version. */
export function impactFeatures(impact: Impact, changes: readonly Change[], known: readonly Feature[]): Feature[] {
  const byId = new Map(known.map((feature) => [feature.id, feature]));
  const out: Feature[] = [];
  const put = (id: string, name: string, kind: string, level: string, geometry: Geometry) =>
    out.push({ id, layer: "drawn", level, part: "", geometry, properties: { class: kind, name } });
  const deleted = new Map(changes.filter(({ change }) => change === "deleted").map((change) => [change.id, change]));
  for (const id of [...impact.edges.deleted, ...impact.nodes.deleted]) {
    const was = deleted.get(id);
    const state = was && stateOf(was, "before");
    if (state) put(id, id, "deleted", state.level, state.geometry);
  }
  for (const id of [...impact.edges.turned, ...impact.nodes.moved.map((node) => node.id)]) {
    const now = byId.get(id);
    if (now) put(id, id, "turned", now.level, now.geometry);
  }
  for (const { id, level, where } of impact.edges.blocked) {
    const now = byId.get(id);
    if (now) put(id, id, "blocked", level, now.geometry);
    else if (where) put(id, id, "blocked", level, pointAt(where));
  }
  for (const { sample, nodes, level, where } of impact.parts) {
    if (where)
      put(sample[0] ?? "part", nodes > 1 ? `${nodes} nodes cut off` : (sample[0] ?? ""), "cut", level, pointAt(where));
  }
  for (const robot of impact.robots) {
    const at = robotPlace(robot, known);
    if (at && robot.state !== "unknown") put(robot.robot, robot.robot, robot.state, at.level, pointAt(at.point));
  }
  return out;
}

/** Where a robot is: its pose, else its node. */
export function robotPlace(
  robot: Impact["robots"][number],
  known: readonly Feature[],
): { point: Position; level: string } | null {
  const node = robot.node ? known.find(({ id, layer }) => id === robot.node && layer === "topology") : undefined;
  const fallback = known.find(({ layer }) => layer === "topology")?.level ?? "ground";
  if (robot.pose) return { point: [robot.pose.x, robot.pose.y], level: robot.pose.level ?? node?.level ?? fallback };
  return node ? { point: centreOf(node.geometry), level: node.level } : null;
}

function pointAt(where: readonly number[]): Geometry {
  return { type: "Point", coordinates: [where[0] ?? 0, where[1] ?? 0] };
}
