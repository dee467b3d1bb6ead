/** Colours of grids, each seen before it is chosen. */
import { cssOf } from "../../map/palette";
import { type PaletteName, palette, theme } from "../../theme";

const NAMES: [PaletteName, string][] = [
  ["plain", "Plain"],
  ["contrast", "For all colour vision"],
  ["costmap", "Costmap (RViz)"],
];
const STOPS = [0, 20, 40, 60, 80, 100];

export function PaletteChoice() {
  return (
    <fieldset class="palettes">
      <legend>Grid colours</legend>
      {NAMES.map(([name, title]) => (
        <label key={name} class="check">
          <input
            type="radio"
            name="palette"
            checked={palette.value === name}
            onChange={() => {
              palette.value = name;
            }}
          />
          <Ramp name={name} />
          {title}
        </label>
      ))}
    </fieldset>
  );
}

/** From free to occupied, then unknown. */
function Ramp({ name }: { name: PaletteName }) {
  const shade = theme.value;
  return (
    <i
      class="ramp"
      aria-hidden="true"
      ref={(element) => {
        if (!element) return;
        const colours = STOPS.map((value) => `${cssOf(name, shade, value)} ${value * 0.8}%`);
        const unknown = cssOf(name, shade, 255);
        element.style.background = `linear-gradient(90deg, ${[...colours, `${unknown} 80%`, unknown].join(", ")})`;
      }}
    />
  );
}
