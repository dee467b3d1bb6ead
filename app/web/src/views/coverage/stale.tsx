/** Derived parts whose inputs have changed since: with the derivation that computes them again. */
import { go } from "../../address";
import { can } from "../../session";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import type { Derivation } from "./derivations";
import { INFORMATION_TEXT } from "./table";

interface Stale {
  layer: string;
  level: string;
  name: string;
  changed: string[];
}

export function StaleNote({ site, derivations }: { site: Site; derivations: Derivation[] | undefined }) {
  const stale = (site.version.value?.stale ?? []) as unknown as Stale[];
  if (!stale.length) return null;
  return (
    <section class="note" aria-label="Out of date">
      <h3>Out of date</h3>
      <p>The inputs of these parts have changed. Maps derive them again; the version still stores the old ones.</p>
      <ul class="plain-list">
        {stale.map(({ layer, level, name, changed }) => (
          <li key={`${layer}/${level}/${name}`} class="stale">
            <span class="grow">
              {INFORMATION_TEXT[layer] ?? layer} “{name}” <small>changed: {changed.join(", ")}</small>
            </span>
            {can("editor") && (
              <Button onClick={() => go({ derive: methodFor(layer, changed, derivations) })}>Derive again</Button>
            )}
          </li>
        ))}
      </ul>
    </section>
  );
}

/** The derivation that gives a layer from one of the changed inputs; else the choice of all. */
function methodFor(layer: string, changed: string[], derivations: Derivation[] = []): string {
  const fitting = derivations.find(
    ({ gives, needs, isGenerator }) =>
      !isGenerator && gives.includes(layer) && needs.some((need) => changed.some((text) => text.includes(need))),
  );
  return fitting?.id ?? "any";
}
