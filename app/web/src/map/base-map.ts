/** The base map below all layers: off unless the operator has configured one and the user switches it on (`base=1` in
 * the address). */
import { signal } from "@preact/signals";
import type { Layer } from "ol/layer";
import { go, param } from "../address";
import { api, ask, type Schemas } from "../api/client";
import type { Frame } from "./frame";

export type BaseMap = Schemas["BaseMapOut"];

/** The configured base map; null: none, or not yet known. */
export const baseMap = signal<BaseMap | null>(null);

let asked = false;

/** Reads once which base map the server allows. */
export async function loadBaseMap(): Promise<void> {
  if (asked) return;
  asked = true;
  try {
    baseMap.value = (await ask(api.GET("/api/v1/page"))).basemap ?? null;
  } catch {
    asked = false; // offline or signed out: with the next site
  }
}

export function isBaseMapShown(): boolean {
  return baseMap.value !== null && param("base") === "1";
}

export function showBaseMap(isShown: boolean): void {
  go({ base: isShown ? 1 : null }, { replace: true });
}

/** Creates the layer, whose code is loaded only now. The map's frame must have a datum. */
export async function createBaseLayer(base: BaseMap, frame: Frame): Promise<Layer> {
  const [{ default: TileLayer }, { default: XYZ }, { registerBaseMap }] = await Promise.all([
    import("ol/layer/Tile"),
    import("ol/source/XYZ"),
    import("./frame"),
  ]);
  registerBaseMap(frame);
  return new TileLayer({ source: new XYZ({ url: base.url, maxZoom: 19, transition: 0 }), zIndex: -1 });
}
