/** Signs and colours of changes, as `DiffLayer` draws them. */
import { CELL_NAMES, cellColour, type DiffGrid } from "../map/diff-layer";

export function DiffLegend({ hasFeatures, grids }: { hasFeatures: boolean; grids: readonly DiffGrid[] }) {
  const cells = CELL_NAMES.filter(([, , member]) => grids.some((grid) => grid[member] > 0));
  if (!hasFeatures && !cells.length) return null;
  return (
    <ul class="diff-legend" aria-label="Legend of changes">
      {hasFeatures &&
        (["added", "changed", "deleted"] as const).map((change) => (
          <li key={change} class={`change ${change}`}>
            <i class={`key line ${change}`} aria-hidden="true" /> {change}
          </li>
        ))}
      {cells.map(([value, name]) => (
        <li key={value}>
          <i
            class="key"
            ref={(element) => {
              if (element) element.style.background = cellColour(value);
            }}
          />{" "}
          {name}
        </li>
      ))}
    </ul>
  );
}
