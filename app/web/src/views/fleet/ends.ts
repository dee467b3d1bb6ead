/** When a closure ends. No DOM. */
export type EndChoice = "15" | "60" | "240" | "tonight" | "until";

export const END_CHOICES: [EndChoice, string][] = [
  ["15", "15 minutes"],
  ["60", "1 hour"],
  ["240", "4 hours"],
  ["tonight", "tonight, 22:00"],
  ["until", "a time …"],
];

/** The end as RFC 3339; `until` is what a datetime-local field holds. After 22:00, tonight is tomorrow's. */
export function endOf(choice: EndChoice, until: string, now: Date): string {
  if (choice === "until") return new Date(until).toISOString();
  if (choice !== "tonight") return new Date(now.getTime() + Number(choice) * 60_000).toISOString();
  const end = new Date(now);
  end.setHours(22, 0, 0, 0);
  if (end <= now) end.setDate(end.getDate() + 1);
  return end.toISOString();
}
