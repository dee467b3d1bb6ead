/** The result of a dry run: on the map, counted, and saved as a version or dropped. */
import { useEffect, useState } from "preact/hooks";
import { go, param } from "../../address";
import { type ApiError, apiPath, asApiError, type DryRun, requestJson, type Version } from "../../api/client";
import { useLoaded } from "../../api/loaded";
import { useChangeLayer } from "../../map/change-layer";
import { loadComparison } from "../../map/changes";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { Findings, Problem, Show } from "../../ui/states";
import { notify } from "../../ui/toast";
import { ChangeList } from "./change-list";
import { changeLines } from "./change-summary";

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
  const diff = useLoaded((signal) => loadComparison(site, String(dry.parent), dry.id, signal), [dry.id]);
  useChangeLayer(map, diff.data?.changes, diff.data, side === "after");
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
        {({ changes }) =>
          changes.length ? <ChangeList site={site} map={map} changes={changes} label="Changes" /> : null
        }
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
