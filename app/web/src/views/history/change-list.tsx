/** What differs, as a list: grids, features by layer, and other parts; with the legend of the map. */
import { Crosshair } from "lucide-preact";
import type { ComponentChildren } from "preact";
import { useState } from "preact/hooks";
import { type Change, type ChangeKind, type Comparison, gridsOf, KINDS } from "../../map/changes";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { ChangeLegend } from "../../ui/change-legend";
import { SearchField } from "../../ui/search-field";
import { Empty } from "../../ui/states";
import { count } from "../../ui/text";
import { type Group, groupsOf } from "./changes";
import { cellsInWords, changesInWords } from "./words";

const SHOWN = 100;
const SIGNS: Record<ChangeKind, string> = { added: "+", changed: "△", deleted: "×" };

interface Props {
  site: Site;
  map: SiteMap;
  comparison: Comparison;
  changes: Change[];
  chosen: Change | null;
  text: string;
  kinds: ReadonlySet<ChangeKind>;
  /** Whether changed cells are drawn; null: this mode does not draw them. */
  cells: boolean | null;
  onText: (text: string) => void;
  onKinds: (kinds: ReadonlySet<ChangeKind>) => void;
  onCells: (cells: boolean) => void;
  onChoose: (change: Change) => void;
  /** The chosen change in full, shown below its row. */
  card: ComponentChildren;
}

export function ChangeList(props: Props) {
  const { comparison, changes, text, kinds, onText, onKinds } = props;
  const isSame = comparison.total === 0 && Object.keys(comparison.layers).length === 0;
  if (isSame) {
    return (
      <Empty title="Both versions have the same content">
        <p>Choose other versions above.</p>
      </Empty>
    );
  }
  const toggle = (kind: ChangeKind) => {
    const next = new Set(kinds);
    if (!next.delete(kind)) next.add(kind);
    onKinds(next);
  };
  return (
    <div class="stack">
      {comparison.changes.length > 0 && (
        <div class="history-part">
          <div class="kinds" role="group" aria-label="Show on the map and in the list">
            {KINDS.map((kind) => (
              <Button key={kind} class={`kind ${kind}`} pressed={kinds.has(kind)} onClick={() => toggle(kind)}>
                <Sign kind={kind} /> {comparison.changes.filter(({ change }) => change === kind).length} {kind}
              </Button>
            ))}
          </div>
          <SearchField label="Search changes" hint="Search by name, id or property" value={text} onInput={onText} />
        </div>
      )}
      <Grids {...props} />
      {groupsOf(changes).map((group) => (
        <ChangeGroup key={group.title} group={group} {...props} />
      ))}
      {comparison.changes.length > 0 && changes.length === 0 && <p class="muted">No change matches.</p>}
      <Others comparison={comparison} />
    </div>
  );
}

export function Sign({ kind }: { kind: ChangeKind }) {
  return (
    <span class={`sign ${kind}`} aria-hidden="true">
      {SIGNS[kind]}
    </span>
  );
}

function ChangeGroup({ group, site, chosen, onChoose, card }: Props & { group: Group }) {
  const [limit, setLimit] = useState(SHOWN);
  const hasLevels = site.levels.value.length > 1;
  const rest = group.changes.length - limit;
  const listed = group.changes.slice(0, limit);
  if (chosen && !listed.includes(chosen) && group.changes.includes(chosen)) listed.push(chosen);
  return (
    <section class="change-group" aria-label={`Changed: ${group.title}`}>
      <h3>
        {group.title} <small>{group.changes.length}</small>
      </h3>
      <ul class="rows">
        {listed.map((change) => (
          <li key={change.key}>
            <button
              type="button"
              class="row"
              aria-pressed={chosen?.key === change.key}
              onClick={() => onChoose(change)}
            >
              <Sign kind={change.change} />
              <span class="grow">
                {change.name} <span class="visually-hidden">{change.change}</span>
              </span>
              <small>
                {change.fields.slice(0, 3).map(fieldName).join(", ") ||
                  (change.kind === change.layer ? "" : change.kind)}
                {hasLevels && ` · ${change.level}`}
              </small>
            </button>
            {chosen === change && card}
          </li>
        ))}
      </ul>
      {rest > 0 && <Button onClick={() => setLimit(limit + 5 * SHOWN)}>Show more of {count(rest, "other")}</Button>}
    </section>
  );
}

export function fieldName(field: string): string {
  return field === "geometry" ? "moved" : field;
}

function Grids({ map, comparison, cells, onCells }: Props) {
  const grids = Object.entries(comparison.layers.occupancy ?? {}) as [string, Record<string, unknown>][];
  if (grids.length === 0) return null;
  return (
    <section class="change-group" aria-label="Changed: grids">
      <h3>Grids</h3>
      <ul class="rows">
        {grids.map(([name, grid]) => (
          <li key={name} class="grid-row">
            <span class="grow">
              {name}
              <small>{cellsInWords(grid) || "description changed"}</small>
            </span>
            {Array.isArray(grid.bbox) && (
              <Button
                quiet
                icon={Crosshair}
                label={`Zoom to the changed cells of ${name}`}
                onClick={() => map.fit(grid.bbox as [number, number, number, number])}
              />
            )}
          </li>
        ))}
      </ul>
      {cells !== null && (
        <>
          <label class="check">
            <input type="checkbox" checked={cells} onChange={(event) => onCells(event.currentTarget.checked)} />
            Draw changed cells
          </label>
          {cells && <ChangeLegend grids={gridsOf(comparison)} />}
        </>
      )}
    </section>
  );
}

/** Parts that are neither features nor grids. */
function Others({ comparison }: { comparison: Comparison }) {
  const { occupancy: _, topology: _t, objects: _o, zones: _z, location: _l, ...others } = comparison.layers;
  const words = changesInWords(others);
  if (words.length === 0) return null;
  return (
    <section class="change-group" aria-label="Changed: other parts">
      <h3>Other parts</h3>
      <ul class="plain-list">
        {words.map((text) => (
          <li key={text}>{text}</li>
        ))}
      </ul>
    </section>
  );
}
