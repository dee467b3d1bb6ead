/** The coverage table: what each format contains of this version. Pure: no page, no network. */
import type { Schemas } from "../../api/client";

export type Format = Schemas["FormatOut"];
export type Coverage = Schemas["CoverageOut"];

/** One kind of information in one format. */
export type State = "raw" | "derived" | "generated" | "template" | "missing" | "derivable" | "none";

export const STATE_TEXT: Record<State, string> = {
  raw: "raw",
  derived: "derived",
  generated: "generated",
  template: "template",
  missing: "missing",
  derivable: "derivable",
  none: "–",
};

export const STATE_MEANING: Record<State, string> = {
  raw: "as it was uploaded or edited",
  derived: "computed from other information",
  generated: "made up by a generator",
  template: "filled in with template values",
  missing: "the format has room for it, this version has none",
  derivable: "not in the file, but computable from what is in it",
  none: "not in this format",
};

/** Order of the columns: the four that robots need come first. */
export const INFORMATION = ["location", "objects", "occupancy", "topology", "zones", "imagery", "voxels"] as const;
export const MAIN_INFORMATION = INFORMATION.slice(0, 4);
export type Information = (typeof INFORMATION)[number];

export const INFORMATION_TEXT: Record<string, string> = {
  location: "Location",
  objects: "Objects",
  occupancy: "Occupancy",
  topology: "Topology",
  zones: "Zones",
  imagery: "Imagery",
  voxels: "Voxels",
};

export const AVAILABILITY_TEXT: Record<Coverage["state"], string> = {
  direct: "available",
  derivable: "available, derived",
  missing: "missing",
};

export interface Step {
  step: string;
  from: string[];
  to: string;
  parameters: Record<string, unknown>;
}

export interface TableRow {
  id: string;
  title: string;
  format: Format;
  state: Coverage["state"];
  steps: Step[];
  missing: string[];
  choose: string | null;
  cells: Record<Information, State>;
}

export function rowsOf(
  formats: readonly Format[],
  coverage: readonly Coverage[],
  information: Record<string, string>,
): TableRow[] {
  const byId = new Map(formats.map((format) => [format.id, format]));
  const rows: TableRow[] = [];
  for (const line of coverage) {
    const format = byId.get(line.format);
    if (!format) continue;
    const steps = line.chain as unknown as Step[];
    rows.push({
      id: format.id,
      title: format.title,
      format,
      state: line.state,
      steps,
      missing: line.missing,
      choose: line.choose ?? null,
      cells: Object.fromEntries(
        INFORMATION.map((layer) => [layer, cellOf(format, layer, information[layer], steps)]),
      ) as Record<Information, State>,
    });
  }
  return rows.sort((one, other) => one.title.localeCompare(other.title));
}

function cellOf(format: Format, layer: Information, own: string | undefined, steps: readonly Step[]): State {
  const given = format.information[layer] ?? "-";
  if (given === "-") return "none";
  if (given === "derived") return "derivable";
  if (own && own !== "missing") return own as State;
  return steps.some(({ to }) => to === layer) ? "derived" : "missing";
}

export function filterRows(rows: readonly TableRow[], text: string, onlyAvailable: boolean): TableRow[] {
  const words = text.toLowerCase().split(/\s+/).filter(Boolean);
  return rows.filter((row) => {
    if (onlyAvailable && row.state === "missing") return false;
    const content = `${row.id} ${row.title} ${row.format.files.join(" ")}`.toLowerCase();
    return words.every((word) => content.includes(word));
  });
}

/** Says what a download is: its file, or a zip of several. */
export function filesText({ files }: Format): string {
  return files.join(", ");
}
