/** The features of the map as a list: to search, and for those who do not use a pointer. */
import { useState } from "preact/hooks";
import { nameOf } from "../../map/features";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { count } from "../../ui/text";
import { SearchField } from "../../ui/search-field";

const SHOWN = 100;

export function FeatureList({ site, map }: { site: Site; map: SiteMap }) {
  const [text, setText] = useState("");
  const wanted = text.trim().toLowerCase();
  const features = site.features.value.filter(
    (feature) =>
      feature.level === site.level.value &&
      (!wanted || `${feature.id} ${nameOf(feature)} ${String(feature.properties.kind)}`.toLowerCase().includes(wanted)),
  );
  return (
    <details class="feature-list" open={Boolean(wanted)}>
      <summary>Features ({features.length})</summary>
      <SearchField label="Search features" hint="Search by name, id or kind" value={text} onInput={setText} />
      <ul class="rows">
        {features.slice(0, SHOWN).map((feature) => (
          <li key={`${feature.layer}/${feature.id}`}>
            <button
              type="button"
              class="row"
              aria-pressed={map.selected.value?.id === feature.id}
              onClick={() => map.select(feature, { show: true })}
            >
              <span class="grow">{nameOf(feature)}</span>
              <small>{String(feature.properties.kind ?? feature.layer)}</small>
            </button>
          </li>
        ))}
      </ul>
      {features.length > SHOWN && (
        <p class="muted">{count(features.length - SHOWN, "more feature")}: search to find them.</p>
      )}
    </details>
  );
}
