/** The files of one upload, and the options that belong to them. */
import type { PickedFile } from "../../dropped";

export interface FormatOption {
  name: string;
  schema: { type: string; enum?: string[]; minimum?: number; maximum?: number; description?: string };
  default: unknown;
  description: string;
  for: string;
}

export interface UploadOptions {
  /** Id of the format; empty: found out by the server. */
  format: string;
  layer: string;
  level: string;
  grid: string;
  mode: "replace" | "merge";
  /** Options of the format, by name; empty: its default. */
  more: Record<string, string>;
}

export const NO_OPTIONS: UploadOptions = { format: "", layer: "", level: "", grid: "", mode: "replace", more: {} };

/** Formats whose lines and polygons have no layer of their own. */
export const DRAWINGS = ["geojson", "kml", "kmz"];
const GRIDS = ["occupancy_grid", "prm", "satellite", "pcd", "ply", "las", "octomap"];
const HIDDEN = /(^|\/)(\.[^/]+|__MACOSX|Thumbs\.db|desktop\.ini)(\/|$)/i;

export interface Added {
  files: PickedFile[];
  /** Number of files of the operating system and of version control, which are no part of a map. */
  hidden: number;
}

/** Adds files to others. One with the same path takes the place of the older one. */
export function addFiles(files: readonly PickedFile[], more: readonly PickedFile[]): Added {
  const wanted = more.filter(({ path }) => !HIDDEN.test(path));
  const byPath = new Map(files.map((one) => [one.path, one]));
  for (const one of wanted) byPath.set(one.path, one);
  return { files: [...byPath.values()], hidden: more.length - wanted.length };
}

export function totalSize(files: readonly PickedFile[]): number {
  return files.reduce((sum, { file }) => sum + file.size, 0);
}

/** Which options make sense for some formats; no formats: not yet known, so all do. */
export function fieldsFor(formats: readonly string[]): { layer: boolean; grid: boolean } {
  const has = (list: string[]) => formats.length === 0 || formats.some((format) => list.includes(format));
  return { layer: has(DRAWINGS), grid: has(GRIDS) };
}

/** Builds the body of `POST …/versions`. */
export function formOf(files: readonly PickedFile[], options: UploadOptions, message: string, dryRun: boolean) {
  const form = new FormData();
  const fields: Record<string, string> = {
    format: options.format,
    layer: options.layer,
    level: options.level.trim(),
    grid: options.grid.trim(),
    mode: options.mode === "merge" ? "merge" : "",
    message: message.trim(),
    dry_run: dryRun ? "true" : "",
    ...options.more,
  };
  for (const [name, value] of Object.entries(fields)) if (value !== "") form.append(name, value);
  for (const { path, file } of files) form.append("files", file, path);
  return form;
}
