/** What a dry run has shown: changes in words and on the map, warnings, and who saved something meanwhile. */
import { Crosshair, Eye, EyeOff, RefreshCw } from "lucide-preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { go } from "../../address";
import type { DryRun, Version } from "../../api/client";
import { checksOf } from "../../checks";
import { DiffLayer } from "../../map/diff-layer";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { DiffLegend } from "../../ui/diff-legend";
import { Bars, Findings, Problem } from "../../ui/states";
import { count, Time } from "../../ui/text";
import type { Desk } from "./desk";
import { featureLines, gridLine, otherLines } from "./words";

interface Props {
  site: Site;
  map: SiteMap;
  dry: DryRun;
}

/** Draws what would change while the component is there. */
export function useDiff(map: SiteMap, from: number | string, to: string): DiffLayer | null {
  const [diff, setDiff] = useState<DiffLayer | null>(null);
  useEffect(() => {
    const layer = new DiffLayer(map, { from, to });
    setDiff(layer);
    void layer.done.then(() => showChanges(layer));
    return () => layer.close();
  }, [map, from, to]);
  return diff;
}

/** Shows the changes; if the level has none, the level that has most. */
function showChanges(layer: DiffLayer): void {
  const counts = new Map<string, number>();
  for (const { level } of [...layer.features.peek(), ...layer.grids.peek()]) {
    counts.set(level, (counts.get(level) ?? 0) + 1);
  }
  const fullest = [...counts].sort((one, other) => other[1] - one[1])[0]?.[0];
  if (fullest !== undefined && !counts.has(layer.level.peek())) go({ level: fullest }, { replace: true });
  layer.fit();
}

export function Result({ site, map, dry }: Props) {
  const diff = useDiff(map, dry.parent, dry.id);
  const top = useRef<HTMLElement>(null);
  useEffect(() => {
    top.current?.scrollIntoView({ block: "start" });
    top.current?.focus({ preventScroll: true }); // the button that was pressed is gone
  }, []);
  const isSame = Object.keys(dry.diff.layers).length === 0;
  return (
    <section class="stack result" ref={top} tabIndex={-1} aria-label="What would change">
      {isSame ? (
        <p class="note">
          These files change nothing: v{dry.parent} already has this content. If you commit, they are kept as its
          sources.
        </p>
      ) : (
        diff && <Changes site={site} diff={diff} changes={dry.diff.layers as Record<string, unknown>} />
      )}
      <ResultChecks site={site} dry={dry} />
      {dry.warnings.length > 0 && (
        <details class="warnings" open={dry.warnings.length <= 5}>
          <summary>{count(dry.warnings.length, "warning")}</summary>
          <Findings items={dry.warnings} />
        </details>
      )}
    </section>
  );
}

/** Mistakes that the result would have, before it is saved. */
function ResultChecks({ site, dry }: { site: Site; dry: DryRun }) {
  const data = checksOf(site).data.value;
  if (data?.version !== dry.id) return null;
  const rules = new Map<string, number>();
  for (const { rule, severity } of data.items) {
    if (severity === "error") rules.set(rule, (rules.get(rule) ?? 0) + 1);
  }
  if (rules.size === 0) return <p class="muted">The checks find no errors in the result.</p>;
  return (
    <div class="note">
      <p>The checks find errors in the result. It can be committed all the same.</p>
      <ul>
        {[...rules].map(([rule, number]) => (
          <li key={rule}>
            {number} × {data.rules.find((one) => one.rule === rule)?.title ?? rule}
          </li>
        ))}
      </ul>
    </div>
  );
}

interface ChangesProps {
  site: Site;
  diff: DiffLayer;
  changes: Record<string, unknown>;
}

/** Changes in words, by level, with the legend of their drawing. */
export function Changes({ site, diff, changes }: ChangesProps) {
  const level = site.level.value;
  const features = diff.features.value;
  const grids = diff.grids.value;
  const lines = featureLines(features);
  const elsewhere = new Map<string, number>();
  for (const one of [...features, ...grids]) {
    if (one.level !== level) elsewhere.set(one.level, (elsewhere.get(one.level) ?? 0) + 1);
  }
  return (
    <>
      <header class="changes-head">
        <h2>What would change</h2>
        <span class="grow" />
        <Button
          quiet
          icon={diff.visible.value ? Eye : EyeOff}
          label="Draw the changes on the map"
          pressed={diff.visible.value}
          onClick={() => diff.setVisible(!diff.visible.peek())}
        />
        <Button quiet icon={Crosshair} label="Show all changes on the map" onClick={() => diff.fit()} />
      </header>
      {diff.problem.value && <Problem error={diff.problem.value} />}
      {diff.loading.value && !lines.length && <Bars />}
      <ul class="changes">
        {lines.map(({ change, text }) => (
          <li key={text} class={`change ${change}`}>
            {text}
          </li>
        ))}
        {grids.map((grid) => (
          <li key={grid.key} class="change cells">
            {gridLine(grid)}
          </li>
        ))}
        {otherLines(changes).map((text) => (
          <li key={text} class="change other">
            {text}
          </li>
        ))}
      </ul>
      {diff.left.value > 0 && (
        <p class="note">Too many changes to draw all: {count(diff.left.value, "feature")} more.</p>
      )}
      {elsewhere.size > 0 && (
        <div class="actions" role="group" aria-label="Changes on other levels">
          {[...elsewhere].map(([name, number]) => (
            <Button key={name} onClick={() => go({ level: name }, { replace: true })}>
              {count(number, "change")} on {name}
            </Button>
          ))}
        </div>
      )}
      <DiffLegend hasFeatures={features.length > 0} grids={grids} />
    </>
  );
}

/** Somebody has saved another version since these files were tried. */
export function Newer({ desk, version }: { desk: Desk; version: Version }) {
  return (
    <div class="problem" role="alert">
      <p class="problem-title">v{version.version} was saved meanwhile</p>
      <p>
        {version.author} saved v{version.version} <Time at={version.time} />
        {version.message ? `: “${version.message}”` : ""}. Your files were tried on an older version. Nothing of yours
        is lost: try them on v{version.version}.
      </p>
      <Button icon={RefreshCw} onClick={() => void desk.tryFiles()}>
        Try again on v{version.version}
      </Button>
    </div>
  );
}
