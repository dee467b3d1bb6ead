/** Meanings and colours of changed cells, as the server numbers them. No DOM. */
type Rgb = [number, number, number];

interface CellWord {
  value: number;
  /** Count of a grid's summary that such cells belong to. */
  count: "blocked" | "freed" | "unknown" | "other";
  title: string;
  light: Rgb;
  dark: Rgb;
}

/** Red and blue are told apart with any colour vision. */
export const WORDS: CellWord[] = [
  { value: 1, count: "blocked", title: "blocked now", light: [203, 36, 49], dark: [255, 110, 100] },
  { value: 2, count: "freed", title: "free now", light: [22, 112, 214], dark: [86, 172, 255] },
  { value: 5, count: "blocked", title: "blocked, unknown before", light: [139, 30, 107], dark: [226, 120, 196] },
  { value: 4, count: "freed", title: "free, unknown before", light: [92, 168, 214], dark: [60, 130, 176] },
  { value: 3, count: "unknown", title: "unknown now", light: [128, 136, 140], dark: [150, 158, 162] },
  { value: 6, count: "other", title: "other value", light: [196, 140, 10], dark: [228, 184, 66] },
];

function colours(theme: "light" | "dark"): Uint32Array {
  const out = new Uint32Array(256);
  for (const word of WORDS) {
    const [red, green, blue] = word[theme];
    out[word.value] = ((165 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
  }
  return out;
}

function css(value: number, theme: "light" | "dark"): string {
  const word = WORDS.find((one) => one.value === value);
  return word ? `rgb(${word[theme].join(" ")})` : "transparent";
}

export const cellWords = { colours, css };
