/** Finds in a stream of events which version a channel had before. No DOM. */

interface Moved {
  type: string;
  channel?: string;
  version: number;
  previous: { version: number } | null;
}

/** Returns the earlier version, null if there was none, and undefined if the text does not tell (yet). */
export function earlierVersion(
  text: string,
  channel: string,
  version: number | null,
  isAll: boolean,
): number | null | undefined {
  const end = isAll ? text.length : text.lastIndexOf("\n\n");
  for (const line of text.slice(0, Math.max(0, end)).split("\n")) {
    if (!line.startsWith("data:")) continue;
    const event = JSON.parse(line.slice(5)) as Moved;
    if (event.type === "channel.moved" && event.channel === channel && event.version === version) {
      return event.previous?.version ?? null;
    }
  }
  return undefined;
}
