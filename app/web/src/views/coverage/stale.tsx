/** Derived parts whose inputs have changed since: with the derivation that computes them again. */
import { go } from "../../address";
import { can } from "../../session";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { INFORMATION_TEXT } from "./table";

export function StaleNote({ site }: { site: Site }) {
  const stale = site.version.value?.stale ?? [];
  if (!stale.length) return null;
  return (
    <section class="note" aria-label="Out of date">
      <h3>Out of date</h3>
      <p>The inputs of these parts have changed. Maps derive them again; the version still stores the old ones.</p>
      <ul class="plain-list">
        {stale.map(({ layer, level, name, changed, method }) => (
          <li key={`${layer}/${level}/${name}`} class="stale">
            <span class="grow">
              {INFORMATION_TEXT[layer] ?? layer} “{name}” <small>changed: {changed.join(", ")}</small>
            </span>
            {can("editor") && (
              <Button onClick={() => go({ derive: method ?? "any", again: `${level}/${name}` })}>Derive again</Button>
            )}
          </li>
        ))}
      </ul>
    </section>
  );
}
