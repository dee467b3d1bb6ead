/** Which map a robot had at a time, from its reports. No DOM. */
export interface Report {
  version: number;
  state: string;
  received: string;
}

/** Returns the report by which a robot had its map at a time: the last `active` one. history: newest first. */
export function heldAt(history: readonly Report[], time: number): Report | null {
  const active = history.filter(({ state }) => state === "active");
  return active.find(({ received }) => Date.parse(received) <= time) ?? null;
}

/** Value of a `datetime-local` field, with seconds. */
export function localTime(time: number): string {
  const date = new Date(time);
  return new Date(time - date.getTimezoneOffset() * 60_000).toISOString().slice(0, 19);
}
