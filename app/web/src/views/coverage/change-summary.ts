/** Changes of a version in words. Pure. */
import { whole } from "../../ui/text";
import { INFORMATION_TEXT } from "./table";

const WORDS = ["added", "changed", "deleted", "freed", "blocked", "unknown"];

/** Returns a line for each layer, such as "Topology: 245 added"; rasters are counted in cells. */
export function changeLines(changes: Record<string, unknown>): string[] {
  const lines: string[] = [];
  for (const [layer, value] of Object.entries(changes)) {
    const title = INFORMATION_TEXT[layer];
    if (!title || typeof value !== "object" || value === null) continue;
    const own = countsOf(value as Record<string, unknown>);
    if (own) {
      lines.push(`${title}: ${own}`);
      continue;
    }
    for (const [name, part] of Object.entries(value)) {
      const counts = typeof part === "object" && part !== null ? countsOf(part as Record<string, unknown>) : "";
      if (counts) lines.push(`${title} “${name}”: ${counts}${layer === "imagery" ? " tiles" : " cells"}`);
    }
  }
  return lines;
}

function countsOf(value: Record<string, unknown>): string {
  return WORDS.filter((word) => typeof value[word] === "number" && value[word] > 0)
    .map((word) => `${whole(value[word] as number)} ${word}`)
    .join(", ");
}
