/** State that a link carries: the query of the page's address, as a signal. */
import { signal } from "@preact/signals";

export type Changes = Record<string, string | number | boolean | null | undefined>;

const query = signal(new URLSearchParams(location.search));

addEventListener("popstate", () => {
  query.value = new URLSearchParams(location.search);
});

/** Returns a value of the address, or null. Components that call it are drawn again when it changes. */
export function param(name: string): string | null {
  return query.value.get(name);
}

/** Returns the address after some changes; null and undefined remove a value. */
export function link(changes: Changes, base: URLSearchParams = query.value): string {
  const next = new URLSearchParams(base);
  for (const [name, value] of Object.entries(changes)) {
    if (value === null || value === undefined || value === false || value === "") next.delete(name);
    else next.set(name, String(value));
  }
  const text = next.toString().replaceAll("%2C", ",").replaceAll("%3A", ":");
  return text ? `/?${text}` : "/";
}

/** Goes to another view; `replace` leaves no step for the browser's Back button. */
export function go(changes: Changes, { replace = false } = {}): void {
  const next = link(changes);
  if (next === location.pathname + location.search) return;
  if (replace) history.replaceState(null, "", next);
  else history.pushState(null, "", next);
  query.value = new URLSearchParams(location.search);
}

/** Goes to an address of this page that does not depend on the present one. */
export function visit(changes: Changes): void {
  history.pushState(null, "", link(changes, new URLSearchParams()));
  query.value = new URLSearchParams(location.search);
}
