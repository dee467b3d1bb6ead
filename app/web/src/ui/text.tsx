/** Numbers and times as people read them. */
import { useEffect, useState } from "preact/hooks";

const LOCALE = "en-GB";
let relative: Intl.RelativeTimeFormat | undefined;
const UNITS: [Intl.RelativeTimeFormatUnit, number][] = [
  ["year", 31_536_000],
  ["month", 2_592_000],
  ["day", 86_400],
  ["hour", 3600],
  ["minute", 60],
];

export function whole(value: number): string {
  return value.toLocaleString(LOCALE);
}

export function count(value: number, one: string, many = `${one}s`): string {
  return `${whole(value)} ${value === 1 ? one : many}`;
}

export function ago(time: string, now = Date.now()): string {
  relative ??= new Intl.RelativeTimeFormat(LOCALE, { numeric: "auto", style: "short" }); // some 20 ms
  const seconds = (Date.parse(time) - now) / 1000;
  for (const [unit, size] of UNITS)
    if (Math.abs(seconds) >= size) return relative.format(Math.round(seconds / size), unit);
  return Math.abs(seconds) < 10 ? "now" : relative.format(Math.round(seconds), "second");
}

/** A time as people say it, exact in the hint; it keeps up by itself. */
export function Time({ at }: { at: string }) {
  const [, tick] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => tick((value) => value + 1), 20_000);
    return () => clearInterval(timer);
  }, []);
  return (
    <time dateTime={at} title={new Date(at).toLocaleString(LOCALE, { dateStyle: "medium", timeStyle: "long" })}>
      {ago(at)}
    </time>
  );
}

export function bytes(size: number): string {
  if (size < 1000) return `${size} B`;
  const [unit, by] = size < 1e6 ? ["kB", 1e3] : size < 1e9 ? ["MB", 1e6] : ["GB", 1e9];
  return `${(size / (by as number)).toPrecision(3)} ${unit}`;
}

export function metres(value: number): string {
  return value >= 1000
    ? `${(value / 1000).toFixed(2)} km`
    : value >= 10
      ? `${value.toFixed(1)} m`
      : `${value.toFixed(2)} m`;
}
