/** What lies on the map: zoom, fit, north, measure, scale, the pointer's place. */
import { signal } from "@preact/signals";
import { Compass, Maximize, Minus, Plus, Ruler } from "lucide-preact";
import { useEffect, useRef } from "preact/hooks";
import { baseMap, isBaseMapShown } from "../map/base-map";
import type { Position } from "../map/features";
import { isHidden, rasterKey } from "../map/site-map";
import type { SiteMap } from "../map/site-map";
import type { Site } from "../site";
import { colour } from "../theme";
import { Button } from "../ui/button";
import { metres } from "../ui/text";

const measured = signal<Position[] | null>(null);

export function MapControls({ site, map }: { site: Site; map: SiteMap }) {
  const zoom = (by: number) => {
    const view = map.map.getView();
    view.animate({ resolution: (view.getResolution() ?? 1) * by, duration: 150 });
  };
  return (
    <>
      <div class="map-buttons">
        <Button icon={Plus} label="Zoom in (+)" onClick={() => zoom(0.5)} />
        <Button icon={Minus} label="Zoom out (-)" onClick={() => zoom(2)} />
        <Button icon={Maximize} label="Show the whole site" onClick={() => map.fit()} />
        <NorthButton site={site} map={map} />
        <Button
          icon={Ruler}
          label="Measure"
          pressed={measured.value !== null}
          onClick={() => {
            measured.value = measured.value ? null : [];
          }}
        />
      </div>
      {measured.value && <Measure map={map} />}
      <footer class="map-foot">
        <ScaleBar map={map} />
        <Pointer site={site} map={map} />
        <Attribution site={site} />
      </footer>
    </>
  );
}

/** Turns the map: the grid's axes up, or north up. */
function NorthButton({ site, map }: { site: Site; map: SiteMap }) {
  const heading = ((site.environment.value?.datum?.heading ?? 0) * Math.PI) / 180;
  const isNorthUp = Math.abs(angle(map.rotation.value - heading)) < 0.01;
  const arrow = useRef<HTMLSpanElement>(null);
  useEffect(() => {
    if (arrow.current) arrow.current.style.transform = `rotate(${map.rotation.value - heading}rad)`;
  }, [map.rotation.value, heading]);
  const turn = () => map.map.getView().animate({ rotation: isNorthUp ? 0 : heading, duration: 200 });
  return (
    <button
      type="button"
      class="button icon-only"
      title={isNorthUp ? "North is up: turn to the grid" : "Turn north up"}
      aria-label={isNorthUp ? "North is up: turn to the grid" : "Turn north up"}
      onClick={turn}
    >
      <span ref={arrow} class="north">
        <Compass size={18} aria-hidden="true" />
      </span>
    </button>
  );
}

function angle(value: number): number {
  return Math.atan2(Math.sin(value), Math.cos(value));
}

function ScaleBar({ map }: { map: SiteMap }) {
  const bar = useRef<HTMLSpanElement>(null);
  const longest = 110 * map.resolution.value;
  const power = 10 ** Math.floor(Math.log10(longest));
  const length = [5, 2, 1].map((step) => step * power).find((step) => step <= longest) ?? power;
  useEffect(() => {
    if (bar.current) bar.current.style.width = `${length / map.resolution.value}px`;
  }, [length, map.resolution.value]);
  return (
    <span class="scale">
      <span ref={bar} class="scale-bar" />
      {length >= 1000
        ? `${length / 1000} km`
        : length >= 1
          ? `${length} m`
          : `${Number((length * 100).toPrecision(2))} cm`}
    </span>
  );
}

function Pointer({ site, map }: { site: Site; map: SiteMap }) {
  const point = map.pointer.value;
  if (!point) return null;
  const earth = site.frame.value?.toWgs84(point);
  return (
    <span class="pointer">
      <span>
        x {point[0].toFixed(2)} y {point[1].toFixed(2)} m
      </span>
      {earth && (
        <span>
          {earth[1].toFixed(7)}, {earth[0].toFixed(7)}
        </span>
      )}
    </span>
  );
}

/** Credits of what is shown: text, never markup. */
function Attribution({ site }: { site: Site }) {
  const shown = site.parts.value.filter(
    (part) => part.level === site.level.value && !isHidden(part.layer) && !isHidden(rasterKey(part)),
  );
  const texts = shown.flatMap(({ attribution }) => attribution);
  if (isBaseMapShown() && site.frame.value && baseMap.value?.attribution) texts.push(baseMap.value.attribution);
  if (!texts.length) return null;
  return <span class="attribution">{[...new Set(texts)].join(" · ")}</span>;
}

/** Measures along clicked points. */
function Measure({ map }: { map: SiteMap }) {
  const points = measured.value ?? [];
  useEffect(() => {
    const layer = map.addLayer({
      classOf: () => "line",
      paints: () => ({ line: { stroke: colour("accent"), width: 2, dash: [4, 4], dot: 9 } }),
    });
    const measure = (_: unknown, point: Position) => {
      measured.value = [...(measured.value ?? []), point];
      return true;
    };
    const release = map.takePicks(measure, { isAbove: true });
    const stop = measured.subscribe((list) => {
      if (!list) return;
      const common = { layer: "drawn" as const, level: "", part: "", properties: {} };
      layer.setFeatures([
        ...(list.length > 1
          ? [{ ...common, id: "line", geometry: { type: "LineString" as const, coordinates: list } }]
          : []),
        { ...common, id: "points", geometry: { type: "MultiPoint" as const, coordinates: list } },
      ]);
    });
    const press = (event: KeyboardEvent) => {
      if (event.key === "Escape") measured.value = null;
    };
    addEventListener("keydown", press);
    return () => {
      stop();
      release();
      map.removeLayer(layer);
      removeEventListener("keydown", press);
    };
  }, [map]);
  const legs = points
    .slice(1)
    .map((point, index) => Math.hypot(point[0] - (points[index]?.[0] ?? 0), point[1] - (points[index]?.[1] ?? 0)));
  const total = legs.reduce((sum, leg) => sum + leg, 0);
  return (
    <output class="measure">
      {points.length < 2
        ? "Click points on the map to measure"
        : `${metres(total)}${legs.length > 1 ? ` · last ${metres(legs.at(-1) ?? 0)}` : ""}`}
    </output>
  );
}
