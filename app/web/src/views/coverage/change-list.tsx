/** Changes as a list that mirrors the map: groups, and in them each feature. */
import { useState } from "preact/hooks";
import { go } from "../../address";
import { type Change, stateOf } from "../../map/changes";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { count } from "../../ui/text";
import { type ChangeGroup, groupsOf, groupText } from "./changes";

const SHOWN = 60;

interface Props {
  site: Site;
  map: SiteMap;
  changes: readonly Change[];
  label: string;
}

export function ChangeList({ site, map, changes, label }: Props) {
  const groups = groupsOf(changes);
  return (
    <ul class="change-list" aria-label={label}>
      {groups.map((group) => (
        <li key={group.key}>
          <GroupRow site={site} map={map} group={group} />
        </li>
      ))}
    </ul>
  );
}

function GroupRow({ site, map, group }: { site: Site; map: SiteMap; group: ChangeGroup }) {
  const [open, setOpen] = useState(false);
  return (
    <details open={open} onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>
        <i class={`change-sign ${group.change}`} aria-hidden="true" />
        <span class="grow">{groupText(group)}</span>
      </summary>
      {open && (
        <ul class="rows">
          {group.changes.slice(0, SHOWN).map((change) => (
            <li key={change.key}>
              <button type="button" class="row" onClick={() => reveal(site, map, change)}>
                <span class="grow">{change.name}</span>
                <small>{change.level !== site.level.value ? change.level : change.id}</small>
              </button>
            </li>
          ))}
          {group.changes.length > SHOWN && <li class="muted">{count(group.changes.length - SHOWN, "more")}</li>}
        </ul>
      )}
    </details>
  );
}

function reveal(site: Site, map: SiteMap, change: Change): void {
  const feature = stateOf(change, "after") ?? stateOf(change, "before");
  if (!feature) return;
  if (feature.level !== site.level.peek()) go({ level: feature.level }, { replace: true });
  map.selected.value = feature;
  map.reveal(feature);
}
