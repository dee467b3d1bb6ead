/** Light, dark, or as the system has it; and the palette of grids. */
import { computed, effect, signal } from "@preact/signals";

export type ThemeChoice = "system" | "light" | "dark";
export type PaletteName = "plain" | "contrast" | "costmap";

const dark = matchMedia("(prefers-color-scheme: dark)");
const systemIsDark = signal(dark.matches);
dark.addEventListener("change", () => {
  systemIsDark.value = dark.matches;
});

export const choice = signal<ThemeChoice>((localStorage.getItem("theme") as ThemeChoice | null) ?? "system");
export const palette = signal<PaletteName>((localStorage.getItem("palette") as PaletteName | null) ?? "plain");

export const theme = computed<"light" | "dark">(() =>
  choice.value === "system" ? (systemIsDark.value ? "dark" : "light") : choice.value,
);

effect(() => {
  document.documentElement.dataset.theme = theme.value;
  localStorage.setItem("theme", choice.value);
  localStorage.setItem("palette", palette.value);
});

/** Reads a colour of the theme, for what is drawn on a canvas. */
export function colour(name: string): string {
  return getComputedStyle(document.documentElement).getPropertyValue(`--map-${name}`).trim();
}
