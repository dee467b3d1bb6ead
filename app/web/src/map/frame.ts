/** The local frame as a projection of OpenLayers: metres, x east, y north, turned by the datum's heading. */
import { addCoordinateTransforms, get as getProjection, Projection } from "ol/proj";
import type { Schemas } from "../api/client";

export type Datum = Schemas["DatumOut"];
export type Point = [number, number];

export const LOCAL = new Projection({ code: "fleetmap:local", units: "m", extent: [-1e7, -1e7, 1e7, 1e7] });

export interface Frame {
  toWgs84: (point: Point) => Point;
  toLocal: (lonlat: Point) => Point;
}

/** Creates the frame of a datum: the transverse Mercator projection around it, turned by its heading. */
export async function createFrame(datum: Datum): Promise<Frame> {
  const proj4 = (await import("proj4")).default;
  const project = proj4(
    "EPSG:4326",
    `+proj=tmerc +lat_0=${datum.latitude} +lon_0=${datum.longitude} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs`,
  );
  const heading = (datum.heading * Math.PI) / 180;
  const cos = Math.cos(heading);
  const sin = Math.sin(heading);
  return {
    toLocal([longitude, latitude]) {
      const [east, north] = project.forward([longitude, latitude]) as Point;
      return [east * cos - north * sin, east * sin + north * cos];
    },
    toWgs84([x, y]) {
      return project.inverse([x * cos + y * sin, y * cos - x * sin]) as Point;
    },
  };
}

/** Lets OpenLayers draw a base map in Web Mercator below the local frame. */
export function registerBaseMap(frame: Frame): void {
  const mercator = getProjection("EPSG:3857");
  if (!mercator) return;
  const radius = 6378137;
  const toDegrees = ([x, y]: number[]): Point => [
    ((x ?? 0) / radius) * (180 / Math.PI),
    (2 * Math.atan(Math.exp((y ?? 0) / radius)) - Math.PI / 2) * (180 / Math.PI),
  ];
  const toMercator = ([longitude, latitude]: Point): Point => [
    ((radius * Math.PI) / 180) * longitude,
    radius * Math.log(Math.tan(Math.PI / 4 + (latitude * Math.PI) / 360)),
  ];
  addCoordinateTransforms(
    LOCAL,
    mercator,
    (point) => toMercator(frame.toWgs84(point as Point)),
    (point) => frame.toLocal(toDegrees(point)),
  );
}
