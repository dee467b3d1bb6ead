/** The result of a dry run: on the map, counted, and saved as a version or dropped. */
import { useEffect, useState } from "preact/hooks";
import { go, param } from "../../address";
import { type ApiError, apiPath, asApiError, type DryRun, requestJson, type Version } from "../../api/client";
import { useLoaded } from "../../api/loaded";
import type { WireFeature } from "../../map/features";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { Findings, Problem, Show } from "../../ui/states";
import { notify } from "../../ui/toast";
import { ChangeList } from "./change-list";
import { changeLines } from "./change-summary";
import { type FeatureChange, fromChange } from "./changes";
import { useChangesOnMap } from "./changes-layer";

const PAGE = 5000;
const MAX_CHANGES = 20_000;
const NONE: FeatureChange[] = [];

interface Props {
  site: Site;
  map: SiteMap;
  dry: DryRun;
  onDrop: () => void;
  onSaved: (version: Version) => void;
}

export function DryRunResult({ site, map, dry, onDrop, onSaved }: Props) {
  const [side, setSide] = useState<"before" | "after">("after");
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<ApiError | null>(null);
  useVersionOnMap(dry, side);
  const diff = useLoaded((signal) => loadChanges(site, dry, signal), [dry.id]);
  const changes = (side === "after" && diff.data) || NONE;
  useChangesOnMap(site, map, changes);
  const save = async () => {
    setBusy(true);
    setProblem(null);
    try {
      const version = await requestJson<Version>(apiPath(site.path("versions")), {
        method: "POST",
        headers: { "content-type": "application/json" },
        body: JSON.stringify({ commit: dry.id }),
      });
      notify(`Saved as v${version.version}`);
      onSaved(version);
    } catch (error) {
      setProblem(asApiError(error));
    } finally {
      setBusy(false);
    }
  };
  const lines = changeLines(dry.changes);
  return (
    <section class="dry-run stack" aria-label="Result of the dry run">
      <h3>Not saved yet</h3>
      <ul class="plain-list">
        {lines.map((line) => (
          <li key={line}>{line}</li>
        ))}
        {lines.length === 0 && <li>Nothing would change.</li>}
      </ul>
      <div class="actions" role="group" aria-label="What the map shows">
        <Button pressed={side === "before"} onClick={() => setSide("before")}>
          Before
        </Button>
        <Button pressed={side === "after"} onClick={() => setSide("after")}>
          After
        </Button>
      </div>
      {dry.warnings.length > 0 && (
        <details class="part">
          <summary>Warnings ({dry.warnings.length})</summary>
          <Findings items={dry.warnings} />
        </details>
      )}
      <Show of={diff}>
        {(list) => (list.length ? <ChangeList site={site} map={map} changes={list} label="Changes" /> : null)}
      </Show>
      {problem && <Problem error={problem} retry={() => void save()} />}
      <div class="actions">
        <Button onClick={onDrop}>Drop it</Button>
        <Button main busy={busy} disabled={lines.length === 0} onClick={() => void save()}>
          Save as a version
        </Button>
      </div>
      <small>
        A dry run is kept for ten minutes, until {new Date(dry.expires).toLocaleTimeString("en-GB")}. Nothing is sent to
        robots before a version is promoted.
      </small>
    </section>
  );
}

/** Shows the dry run, or what was shown before it; the latter again at the end. */
function useVersionOnMap(dry: DryRun, side: "before" | "after"): void {
  const [prior] = useState(() => (param("version")?.startsWith("dry:") ? null : param("version")));
  useEffect(() => {
    go({ version: side === "after" ? dry.id : prior }, { replace: true });
  }, [dry.id, side, prior]);
  useEffect(
    () => () => {
      if (param("version") === dry.id) go({ version: prior }, { replace: true });
    },
    [dry.id, prior],
  );
}

async function loadChanges(site: Site, dry: DryRun, signal: AbortSignal): Promise<FeatureChange[]> {
  const out: FeatureChange[] = [];
  let cursor: string | undefined;
  do {
    const query = { from: dry.parent, to: dry.id, format: "geojson", crs: "local", limit: PAGE, cursor };
    const page = await requestJson<{ features: WireFeature[]; next?: string }>(apiPath(site.path("diff"), query), {
      signal,
    });
    out.push(...page.features.map(fromChange).filter((one) => one !== null));
    cursor = page.next;
  } while (cursor && out.length < MAX_CHANGES);
  return out;
}
