/** Colours of grid values: 0 free … 100 occupied, 255 unknown. */
import type { PaletteName } from "../theme";

type Rgb = [number, number, number];

interface Ramp {
  stops: [number, Rgb][];
  unknown: Rgb;
}

const RAMPS: Record<PaletteName, Record<"light" | "dark", Ramp>> = {
  plain: {
    light: {
      stops: [
        [0, [253, 253, 250]],
        [100, [38, 44, 52]],
      ],
      unknown: [222, 225, 226],
    },
    dark: {
      stops: [
        [0, [38, 44, 50]],
        [100, [222, 228, 232]],
      ],
      unknown: [22, 26, 30],
    },
  },
  // Told apart with any colour vision: lightness alone orders it (after the scale cividis).
  contrast: {
    light: {
      stops: [
        [0, [255, 234, 70]],
        [50, [124, 123, 120]],
        [100, [0, 32, 76]],
      ],
      unknown: [240, 240, 240],
    },
    dark: {
      stops: [
        [0, [0, 32, 76]],
        [50, [124, 123, 120]],
        [100, [255, 234, 70]],
      ],
      unknown: [18, 18, 20],
    },
  },
  costmap: {
    light: {
      stops: [
        [0, [250, 250, 250]],
        [1, [66, 90, 190]],
        [65, [200, 60, 110]],
        [100, [110, 10, 30]],
      ],
      unknown: [214, 219, 214],
    },
    dark: {
      stops: [
        [0, [26, 30, 36]],
        [1, [60, 96, 200]],
        [65, [220, 90, 140]],
        [100, [255, 190, 170]],
      ],
      unknown: [40, 46, 44],
    },
  },
};

/** Returns RGBA for each of the 256 values. overPicture: free and unknown cells let a picture below be seen. */
export function coloursOf(name: PaletteName, theme: "light" | "dark", overPicture = false): Uint32Array {
  const { stops, unknown } = RAMPS[name][theme];
  const out = new Uint32Array(256);
  for (let value = 0; value <= 100; value++) {
    const upper = Math.max(
      1,
      stops.findIndex(([at]) => at >= value),
    );
    const [low, from] = stops[upper - 1] as [number, Rgb];
    const [high, to] = stops[upper] as [number, Rgb];
    const share = (value - low) / (high - low);
    const mixed = from.map((part, index) => Math.round(part + share * ((to[index] ?? 0) - part))) as Rgb;
    out[value] = rgba(mixed, overPicture ? Math.min(255, value * 4) : 255);
  }
  out.fill(rgba([255, 0, 200], 255), 101, 255); // not a cell's value: to be seen
  out[255] = rgba(unknown, overPicture ? 0 : 255);
  return out;
}

export function cssOf(name: PaletteName, theme: "light" | "dark", value: number): string {
  const word = coloursOf(name, theme)[value] ?? 0;
  return `rgb(${word & 255} ${(word >> 8) & 255} ${(word >> 16) & 255})`;
}

/** Colours of masks: what is set is tinted, all else transparent. */
export function maskColours([red, green, blue]: Rgb): Uint32Array {
  const out = new Uint32Array(256);
  for (let value = 1; value <= 100; value++) out[value] = rgba([red, green, blue], 60 + value);
  return out;
}

function rgba([red, green, blue]: Rgb, alpha: number): number {
  return ((alpha << 24) | (blue << 16) | (green << 8) | red) >>> 0;
}
