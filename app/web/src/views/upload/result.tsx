/** What a dry run has shown: changes in words and on the map, warnings, and who saved something meanwhile. */
import { Crosshair, Eye, EyeOff, RefreshCw } from "lucide-preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { go } from "../../address";
import type { DryRun, Version } from "../../api/client";
import { type Loaded, useLoaded } from "../../api/loaded";
import { checksOf } from "../../checks";
import { useChangeLayer } from "../../map/change-layer";
import { boxOfChanges, type Comparison, gridsOf, loadComparison } from "../../map/changes";
import { joinBoxes } from "../../map/features";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { ChangeLegend } from "../../ui/change-legend";
import { Findings, Show } from "../../ui/states";
import { count, Time } from "../../ui/text";
import type { Desk } from "./desk";
import { featureLines, gridLine, otherLines } from "./words";

interface Props {
  site: Site;
  map: SiteMap;
  dry: DryRun;
}

/** What differs between two versions, drawn while the component is there and not switched off. */
export interface Diff {
  of: Loaded<Comparison>;
  isVisible: boolean;
  setVisible: (isVisible: boolean) => void;
}

export function useDiff(map: SiteMap, from: number, to: string): Diff {
  const { site } = map;
  const of = useLoaded((signal) => loadComparison(site, String(from), to, signal), [site.name, from, to]);
  const [isVisible, setVisible] = useState(true);
  useChangeLayer(map, of.data?.changes, of.data, isVisible);
  useEffect(() => {
    if (of.data) showChanges(map, of.data);
  }, [of.data]);
  return { of, isVisible, setVisible };
}

/** Shows the changes; if the level has none, the level that has most. */
function showChanges(map: SiteMap, comparison: Comparison): void {
  const counts = countByLevel(comparison);
  const fullest = [...counts].sort((one, other) => other[1] - one[1])[0]?.[0];
  const level = map.site.level.peek();
  if (fullest !== undefined && !counts.has(level)) go({ level: fullest }, { replace: true });
  fit(map, comparison);
}

function countByLevel(comparison: Comparison): Map<string, number> {
  const counts = new Map<string, number>();
  for (const { level } of [...comparison.changes, ...gridsOf(comparison)]) {
    counts.set(level, (counts.get(level) ?? 0) + 1);
  }
  return counts;
}

/** Moves the map to all that differs on the level shown. */
function fit(map: SiteMap, comparison: Comparison): void {
  const here = ({ level }: { level: string }) => level === map.site.level.peek();
  const boxes = [
    boxOfChanges(comparison.changes.filter(here)),
    ...gridsOf(comparison)
      .filter(here)
      .map(({ bbox }) => bbox),
  ];
  map.fit(joinBoxes(boxes.filter((box) => box !== null)));
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
        <Changes map={map} diff={diff} changes={dry.diff.layers as Record<string, unknown>} />
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
  map: SiteMap;
  diff: Diff;
  changes: Record<string, unknown>;
}

/** Changes in words, by level, with the legend of their drawing. */
export function Changes({ map, diff, changes }: ChangesProps) {
  const { of, isVisible, setVisible } = diff;
  return (
    <>
      <header class="changes-head">
        <h2>What would change</h2>
        <span class="grow" />
        <Button
          quiet
          icon={isVisible ? Eye : EyeOff}
          label="Draw the changes on the map"
          pressed={isVisible}
          onClick={() => setVisible(!isVisible)}
        />
        <Button
          quiet
          icon={Crosshair}
          label="Show all changes on the map"
          disabled={!of.data}
          onClick={() => of.data && fit(map, of.data)}
        />
      </header>
      <Show of={of}>{(comparison) => <Lines map={map} comparison={comparison} changes={changes} />}</Show>
    </>
  );
}

type LinesProps = Pick<ChangesProps, "map" | "changes"> & { comparison: Comparison };

function Lines({ map, comparison, changes }: LinesProps) {
  const level = map.site.level.value;
  const grids = gridsOf(comparison);
  const left = comparison.total - comparison.changes.length;
  const elsewhere = [...countByLevel(comparison)].filter(([name]) => name !== level);
  return (
    <>
      <ul class="changes">
        {featureLines(comparison.changes).map(({ change, text }) => (
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
      {left > 0 && <p class="note">Too many changes to draw all: {count(left, "feature")} more.</p>}
      {elsewhere.length > 0 && (
        <div class="actions" role="group" aria-label="Changes on other levels">
          {elsewhere.map(([name, number]) => (
            <Button key={name} onClick={() => go({ level: name }, { replace: true })}>
              {count(number, "change")} on {name}
            </Button>
          ))}
        </div>
      )}
      <ChangeLegend hasFeatures={comparison.changes.length > 0} grids={grids} />
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
