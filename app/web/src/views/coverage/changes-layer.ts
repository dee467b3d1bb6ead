/** Changed features drawn over the map, by colour and sign. */
import { useEffect } from "preact/hooks";
import { isArea, linesOf } from "../../map/features";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { colour } from "../../theme";
import type { FeatureChange } from "./changes";

const OVER_ALL = 21;
/** Above this number signs would cover the map: colour and dashes remain. */
const MAX_SIGNS = 400;

/** Draws changes of the level shown for as long as the component is there. */
export function useChangesOnMap(site: Site, map: SiteMap, changes: readonly FeatureChange[]): void {
  const level = site.level.value;
  useEffect(() => {
    const shown = changes.filter(({ feature }) => feature.level === level);
    const classes = new Map<string, string>();
    const signed = shown.length <= MAX_SIGNS;
    const features = shown.flatMap(({ key, feature, before, change }) => {
      const drawn = { ...feature, id: key };
      const isLine = !isArea(feature.geometry) && linesOf(feature.geometry).length > 0;
      classes.set(key, `${change}${signed && !isLine ? "-signed" : ""}`);
      if (!before) return [drawn];
      classes.set(`${key} before`, "before");
      return [drawn, { ...before, id: `${key} before` }];
    });
    const layer = map.addLayer(
      {
        classOf: ({ id }) => classes.get(id) ?? "",
        paints: () => ({
          before: { stroke: colour("deleted"), width: 1.5, dash: [2, 4], dot: 5 },
          ...paintsOf("added", "plus"),
          ...paintsOf("changed", "triangle"),
          ...paintsOf("deleted", "cross", [7, 4]),
        }),
      },
      OVER_ALL,
    );
    layer.setFeatures(features);
    return () => map.removeLayer(layer);
  }, [map, changes, level]);
}

function paintsOf(change: string, sign: "plus" | "triangle" | "cross", dash?: number[]) {
  const stroke = colour(change);
  const paint = { stroke, width: 2.5, dash, dot: sign === "cross" ? 5 : 9 }; // no fill: areas lie over each other
  return { [change]: paint, [`${change}-signed`]: { ...paint, sign } };
}
