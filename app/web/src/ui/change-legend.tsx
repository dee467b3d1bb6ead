/** Signs and colours of changes, as `ChangeLayer` draws them. */
import { CELL_WORDS, type GridChange, KINDS } from "../map/changes";
import { theme } from "../theme";

export function ChangeLegend({ hasFeatures, grids }: { hasFeatures?: boolean; grids: readonly GridChange[] }) {
  const shown = theme.value;
  const cells = CELL_WORDS.filter(({ count }) => grids.some((grid) => grid[count] > 0));
  if (!hasFeatures && !cells.length) return null;
  return (
    <ul class="diff-legend" aria-label="Legend of changes">
      {hasFeatures &&
        KINDS.map((change) => (
          <li key={change} class={`change ${change}`}>
            <i class={`key line ${change}`} aria-hidden="true" /> {change}
          </li>
        ))}
      {cells.map((word) => (
        <li key={word.value}>
          <i
            class="key"
            ref={(element) => {
              if (element) element.style.background = `rgb(${word[shown].join(" ")})`;
            }}
          />{" "}
          {word.title}
        </li>
      ))}
    </ul>
  );
}
