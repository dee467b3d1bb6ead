/** Comparison of two versions: the map, what changed as a list, and restoring. */
import { ArrowLeftRight, ChevronLeft, History, Rocket, Save } from "lucide-preact";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { go, param } from "../../address";
import { type DryRun, online } from "../../api/client";
import { useLoaded } from "../../api/loaded";
import { boxOfChanges, type Change, type ChangeKind, type Comparison, KINDS, loadComparison } from "../../map/changes";
import { can } from "../../session";
import type { Site } from "../../site";
import { theme } from "../../theme";
import { Button } from "../../ui/button";
import { Show } from "../../ui/states";
import { count } from "../../ui/text";
import { attempt, notify } from "../../ui/toast";
import type { ViewProps } from "../registry";
import { ChangeCard } from "./change-card";
import { ChangeList } from "./change-list";
import { filterChanges } from "./changes";
import { CompareMap, type Mode } from "./compare-map";
import type { Versions } from "./loads";
import { BlinkControl, ModeChoice, Swipe, useBlink } from "./modes";
import { RestoreDialog, commitRun } from "./restore-dialog";
import { Tracks } from "./tracks";
import { refName } from "./words";

interface Props extends ViewProps {
  from: string;
  to: string;
  versions: Versions;
}

const MODES: Mode[] = ["overlay", "swipe", "blink"];

export function Compare({ site, map, from, to, versions }: Props) {
  const loaded = useLoaded(
    (signal) => loadComparison(site, from, to, signal),
    [site.name, from, to, headOf(site, from, to)],
  );
  const [restored, setRestored] = useState<number | null>(null);
  const last = useRef<Comparison | undefined>(undefined);
  if (loaded.data) last.current = loaded.data;
  const shown = { ...loaded, data: loaded.data ?? last.current };
  return (
    <div class="stack" aria-label={`Comparison of ${refName(from)} and ${refName(to)}`}>
      <header class="history-head">
        <Button quiet icon={ChevronLeft} label="Back to the versions" onClick={leave} />
        <h2 class="grow">
          {refName(from)} → {refName(to)}
        </h2>
        <Button
          quiet
          icon={ArrowLeftRight}
          label="Swap both versions"
          onClick={() => go({ from: to, to: from, change: null })}
        />
      </header>
      <Tracks from={from} to={to} versions={versions.data?.versions ?? []} />
      <Show of={shown}>{(comparison) => <Compared site={site} map={map} comparison={comparison} />}</Show>
      <Ends site={site} from={from} to={to} onRestore={setRestored} />
      <RestoreDialog site={site} version={restored} onClose={() => setRestored(null)} />
    </div>
  );
}

function leave(): void {
  go({
    from: null,
    to: null,
    mode: null,
    change: null,
    version: /^(dry|draft):/.test(param("to") ?? "") ? null : param("to"),
  });
}

/** References by name, such as `latest`, are compared again when the head moves. */
function headOf(site: Site, ...refs: string[]): number | undefined {
  return refs.every((ref) => /^(\d+|(dry|draft):.*)$/.test(ref)) ? undefined : site.environment.value?.version;
}

function Compared({ site, map, comparison }: ViewProps & { comparison: Comparison }) {
  const asked = param("mode") as Mode | null;
  const mode = asked && MODES.includes(asked) ? asked : "overlay";
  const [text, setText] = useState("");
  const [kinds, setKinds] = useState<ReadonlySet<ChangeKind>>(new Set(KINDS));
  const [cells, setCells] = useState(true);
  const [share, setShare] = useState(0.5);
  const blink = useBlink(mode === "blink");
  const level = site.level.value;
  const changes = useMemo(() => filterChanges(comparison.changes, text, kinds), [comparison, text, kinds]);
  const key = param("change");
  const chosen = comparison.changes.find((change) => change.key === key) ?? null;
  const view = useCompareMap({ map });
  useEffect(() => view.current?.show(comparison, changes, level, mode), [comparison, changes, level, mode]);
  useEffect(() => view.current?.set(share, blink.phase, cells), [share, blink.phase, cells]);
  useEffect(() => view.current?.choose(chosen?.level === level ? chosen : null), [chosen, level]);
  useEffect(() => view.current?.repaint(), [theme.value]);
  useFirstFit(map, comparison);
  const choose = (change: Change | null) => {
    go({ change: change?.key ?? null, ...(change && { level: change.level }) }, { replace: true });
    const box = change && boxOfChanges([change]);
    if (box) map.fit([box[0] - 4, box[1] - 4, box[2] + 4, box[3] + 4]);
  };
  const card = chosen && (
    <ChangeCard key={chosen.key} site={site} comparison={comparison} change={chosen} onClose={() => choose(null)} />
  );
  return (
    <div class="stack">
      <ModeChoice mode={mode} />
      {mode === "blink" && <BlinkControl blink={blink} from={comparison.from} to={comparison.to} />}
      {mode === "swipe" && (
        <Swipe
          map={map}
          share={share}
          onShare={setShare}
          left={refName(comparison.from)}
          right={refName(comparison.to)}
        />
      )}
      {chosen && !changes.includes(chosen) && card}
      <ChangeList
        site={site}
        map={map}
        comparison={comparison}
        changes={changes}
        chosen={chosen}
        text={text}
        kinds={kinds}
        cells={mode === "overlay" ? cells : null}
        onText={setText}
        onKinds={setKinds}
        onCells={setCells}
        onChoose={(change) => choose(change === chosen ? null : change)}
        card={card}
      />
      {comparison.total > comparison.changes.length && (
        <p class="note" role="note">
          {count(comparison.total, "feature")} changed: the first {count(comparison.changes.length, "is", "are")} listed
          and drawn.
        </p>
      )}
    </div>
  );
}

/** The comparison on the map, while the view is open. */
function useCompareMap({ map }: Pick<ViewProps, "map">) {
  const view = useRef<CompareMap | null>(null);
  if (!view.current) view.current = new CompareMap(map);
  useEffect(() => {
    const release = map.takePicks((feature, point, event) => {
      const pixels = (event as PointerEvent).pointerType === "touch" ? 22 : 10;
      const key = view.current?.pick(point, pixels * map.resolution.peek()) ?? null;
      if (key) go({ change: key }, { replace: true });
      else if (!feature) go({ change: null }, { replace: true });
      return key !== null;
    });
    return () => {
      release();
      view.current?.close();
      view.current = null;
    };
  }, [map]);
  return view;
}

/** Moves the map to the changes once, if none of them is seen and the address names no place. */
function useFirstFit(map: ViewProps["map"], comparison: Comparison): void {
  const done = useRef("");
  useEffect(() => {
    const key = `${comparison.from}/${comparison.to}`;
    if (done.current === key) return;
    const isFirst = done.current === "";
    done.current = key;
    const own = comparison.changes.filter((change) => change.level === map.site.level.peek());
    const box = boxOfChanges(own);
    if (!box || (isFirst && param("change"))) return;
    const [a = 0, b = 0, c = 0, d = 0] = map.map.getView().calculateExtent(map.map.getSize());
    const isSeen = box[0] < c && box[2] > a && box[1] < d && box[3] > b;
    if (!isSeen) map.fit(box);
  }, [comparison]);
}

interface EndsProps {
  site: Site;
  from: string;
  to: string;
  onRestore: (version: number) => void;
}

/** What may be done with both versions. */
function Ends({ site, from, to, onRestore }: EndsProps) {
  if (!can("editor")) return null;
  const head = site.environment.value?.version;
  const run = site.version.value;
  return (
    <div class="actions">
      {/^\d+$/.test(from) && Number(from) > 0 && Number(from) !== head && (
        <Button icon={History} onClick={() => onRestore(Number(from))}>
          Restore {refName(from)}…
        </Button>
      )}
      {/^\d+$/.test(to) && (
        <Button icon={Rocket} onClick={() => go({ promote: to })}>
          Promote {refName(to)}…
        </Button>
      )}
      {run?.version === null && run.id === to && to.startsWith("dry:") && (
        <Button main icon={Save} disabled={!online.value} onClick={() => void save(site, run)}>
          Save this as a version
        </Button>
      )}
    </div>
  );
}

async function save(site: Site, run: DryRun): Promise<void> {
  const made = await attempt(() => commitRun(site, run, run.message));
  if (!made) return;
  notify(`Saved as v${made.version}`, { action: { label: "Promote…", run: () => go({ promote: made.version }) } });
  go({ to: made.version, version: made.version, change: null }, { replace: true });
  await site.refresh();
}
