/** Findings on the map: a sign for each, by severity, and what the chosen one is about. */
import { effect } from "@preact/signals";
import { useEffect } from "preact/hooks";
import type { Finding } from "../../checks";
import type { FeatureStyle } from "../../map/feature-layer";
import { distanceTo, type Feature } from "../../map/features";
import type { SiteMap } from "../../map/site-map";
import { colour, theme } from "../../theme";
import { keyOf } from "./fixes";

const COLOURS = { error: "deleted", warning: "changed", info: "edge" } as const;
const SIGNS = { error: "cross", warning: "triangle", info: "ring" } as const;
const Z_MARKS = 24;
const REACH = 14;

const MARKS: FeatureStyle = {
  classOf: (feature) => String(feature.properties.severity),
  paints: () =>
    Object.fromEntries(
      (["info", "warning", "error"] as const).map((severity) => [
        severity,
        { stroke: colour(COLOURS[severity]), dot: 3, sign: SIGNS[severity] },
      ]),
    ),
};

const CHOSEN: FeatureStyle = {
  classOf: () => "chosen",
  paints: () => ({
    chosen: {
      stroke: colour("accent"),
      width: 5,
      dot: 12,
      fill: `color-mix(in srgb, ${colour("accent")} 25%, transparent)`,
    },
  }),
};

function markOf(finding: Finding): Feature {
  return {
    id: keyOf(finding),
    layer: "drawn",
    level: finding.level,
    part: "",
    geometry: { type: "Point", coordinates: finding.where ?? [] },
    properties: { severity: finding.severity },
  };
}

/** Features that a finding is about. */
export function featuresOf(map: SiteMap, finding: Finding): Feature[] {
  return finding.ids.map((id) => map.index.byId.get(id)).filter((feature) => feature !== undefined);
}

/** Moves the map to a finding, with some of what is around it. */
export function showFinding(map: SiteMap, finding: Finding): void {
  if (!finding.where) return map.fitFeatures(featuresOf(map, finding));
  const [x = 0, y = 0] = finding.where;
  map.fit([x - 8, y - 8, x + 8, y + 8]);
}

/** Draws the findings of the level; a click on a sign chooses its finding. */
export function useMarks(
  map: SiteMap,
  findings: readonly Finding[],
  chosen: Finding | undefined,
  choose: (finding: Finding) => void,
): void {
  const level = map.site.level.value;
  const features = map.site.features.value;
  useEffect(() => {
    const here = findings.filter((finding) => finding.where && finding.level === level);
    const marks = here.map(markOf);
    const layer = map.addLayer(MARKS, Z_MARKS);
    layer.setFeatures(marks);
    const release = map.takePicks((_, point) => {
      const reach = REACH * map.resolution.peek();
      const near = marks
        .map((mark, index) => ({ index, distance: distanceTo(mark.geometry, point) }))
        .filter(({ distance }) => distance <= reach)
        .sort((one, other) => one.distance - other.distance)[0];
      const finding = near && here[near.index];
      if (finding) choose(finding);
      return finding !== undefined;
    });
    const stop = effect(() => {
      theme.value;
      requestAnimationFrame(() => layer.repaint());
    });
    return () => {
      stop();
      release();
      map.removeLayer(layer);
    };
  }, [map, findings, level]);
  const key = chosen && keyOf(chosen);
  useEffect(() => {
    if (!chosen || chosen.level !== level) return;
    const layer = map.addLayer(CHOSEN, Z_MARKS - 1);
    layer.setFeatures(featuresOf(map, chosen));
    return () => map.removeLayer(layer);
  }, [map, key, level, features]);
}
