/** What an upload or an edit changes, in words. */
import type { Change, ChangeKind, GridChange } from "../../map/changes";
import { count } from "../../ui/text";

export interface Line {
  change: ChangeKind;
  text: string;
}

const VERBS: ChangeKind[] = ["deleted", "changed", "added"];
const MANY: Record<string, string> = { fence: "fences", zone: "zones", category: "categories", box: "boxes" };
const LAYERS: Record<string, string> = {
  location: "Fence and datum",
  resources: "Attached files",
  imagery: "Pictures",
  voxels: "Voxels",
  datum: "Datum",
  levels: "Levels",
  templates: "Template values",
};

/** Counts features by kind and change, what is deleted first: "3 nodes deleted". */
export function featureLines(changes: readonly Change[]): Line[] {
  const counts = new Map<string, number>();
  for (const { change, kind } of changes) {
    const key = `${change} ${kind}`;
    counts.set(key, (counts.get(key) ?? 0) + 1);
  }
  return VERBS.flatMap((change) =>
    [...counts]
      .filter(([key]) => key.startsWith(`${change} `))
      .map(([key, number]) => ({ change, text: `${countOf(number, key.slice(change.length + 1))} ${change}` })),
  );
}

export function countOf(number: number, kind: string): string {
  const word = kind.replaceAll("_", " ");
  return count(number, word, MANY[word] ?? (word.endsWith("s") ? word : `${word}s`));
}

/** Says which cells of a grid change: "map: 120 cells blocked, 4 freed". */
export function gridLine({ key, freed, blocked, unknown, other }: GridChange): string {
  const parts = [
    blocked && `${count(blocked, "cell")} blocked`,
    freed && `${count(freed, "cell")} freed`,
    unknown && `${count(unknown, "cell")} unknown now`,
    other && `${count(other, "cell")} otherwise`,
  ].filter(Boolean);
  return `Grid ${key}: ${parts.length ? parts.join(", ") : "other frame or name"}`;
}

/** Names what else changes, beside features and grids. */
export function otherLines(changes: Record<string, unknown>): string[] {
  return Object.keys(changes)
    .filter((layer) => !["topology", "objects", "zones", "occupancy"].includes(layer))
    .map((layer) => `${LAYERS[layer] ?? layer}: ${describe(changes[layer])}`);
}

interface Move {
  from: unknown;
  to: unknown;
}

function describe(value: unknown): string {
  const { to } = (value ?? {}) as Partial<Move>;
  if (Array.isArray(to)) return to.map((one: { name?: string }) => one.name ?? "").join(", ");
  if (to && typeof to === "object" && "latitude" in to) {
    const { latitude, longitude, heading } = to as Record<string, number>;
    return `latitude ${latitude?.toFixed(7)}, longitude ${longitude?.toFixed(7)}, heading ${heading ?? 0}°`;
  }
  const lists = Object.values((value ?? {}) as Record<string, unknown>);
  const total = { added: 0, changed: 0, deleted: 0 };
  for (const one of [value, ...lists] as Partial<typeof total>[]) {
    for (const key of ["added", "changed", "deleted"] as const) {
      const number = one?.[key];
      if (typeof number === "number") total[key] += number;
    }
  }
  const parts = Object.entries(total).filter(([, number]) => number > 0);
  return parts.length ? parts.map(([key, number]) => `${number} ${key}`).join(", ") : "changed";
}
