/** One changed feature: both states side by side, and restoring the earlier one. */
import { RotateCcw, X } from "lucide-preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { go } from "../../address";
import { type ApiError, asApiError, requestJson, apiPath, type Version } from "../../api/client";
import type { Change, Comparison } from "../../map/changes";
import { can } from "../../session";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { Problem } from "../../ui/states";
import { count } from "../../ui/text";
import { notify } from "../../ui/toast";
import { Sign } from "./change-list";
import { restoreEdits, undoneWith, valueRows } from "./changes";
import { refName } from "./words";

interface Props {
  site: Site;
  comparison: Comparison;
  change: Change;
  onClose: () => void;
}

export function ChangeCard({ site, comparison, change, onClose }: Props) {
  const element = useRef<HTMLElement>(null);
  useEffect(() => element.current?.scrollIntoView({ block: "nearest" }), []);
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<ApiError | null>(null);
  const together = undoneWith(change, comparison.changes);
  const title = change.change === "added" ? "Take it out again" : "Restore this";
  const restore = async () => {
    setBusy(true);
    setProblem(null);
    try {
      const version = await putBack(site, together, `${title}: ${change.name}, as in ${refName(comparison.from)}`);
      notify(`${change.name} is as in ${refName(comparison.from)} again: saved as v${version.version}`);
      const wasHead = String(site.environment.peek()?.version) === comparison.to || comparison.to === "latest";
      if (wasHead) go({ to: version.version, version: version.version, change: null }, { replace: true });
      await site.refresh();
    } catch (error) {
      setProblem(asApiError(error));
    } finally {
      setBusy(false);
    }
  };
  return (
    <article ref={element} class="feature-card change-card" aria-label={`Change of ${change.name}`}>
      <header>
        <Sign kind={change.change} />
        <span class="grow">
          <b>{change.name}</b>
          <small>
            {change.kind} {change.change}
            {change.name !== change.id && ` · ${change.id}`}
          </small>
        </span>
        <Button quiet icon={X} label="Close" onClick={onClose} />
      </header>
      <Values change={change} comparison={comparison} />
      {problem && <Problem error={problem} />}
      {can("editor") && (
        <div class="actions">
          <Button icon={RotateCcw} busy={busy} onClick={() => void restore()}>
            {title}
            {together.length > 1 && ` with ${otherWords(together.slice(1))}`}
          </Button>
        </div>
      )}
    </article>
  );
}

function otherWords(others: Change[]): string {
  return others.every(({ kind }) => kind === "edge") ? count(others.length, "edge") : count(others.length, "node");
}

function Values({ change, comparison }: { change: Change; comparison: Comparison }) {
  const rows = valueRows(change);
  return (
    <div class="values">
      <table>
        <thead>
          <tr>
            <th scope="col">
              <span class="visually-hidden">Property</span>
            </th>
            {change.before && <th scope="col">{refName(comparison.from)}</th>}
            {change.after && <th scope="col">{refName(comparison.to)}</th>}
          </tr>
        </thead>
        <tbody>
          {rows.map((row) => (
            <tr key={row.name} class={row.differs && change.change === "changed" ? "differs" : undefined}>
              <th scope="row">{row.name}</th>
              {change.before && <td>{row.before || "–"}</td>}
              {change.after && <td>{row.after || "–"}</td>}
            </tr>
          ))}
        </tbody>
      </table>
    </div>
  );
}

/** Commits the earlier states on the head. Throws ApiError: 412 if the head has moved meanwhile. */
async function putBack(site: Site, changes: Change[], message: string): Promise<Version> {
  const head = site.environment.peek()?.version;
  return requestJson<Version>(apiPath(site.path("edits")), {
    method: "POST",
    headers: {
      "content-type": "application/json",
      "if-match": `"${head}"`,
    },
    body: JSON.stringify({ message, changes: restoreEdits(changes) }),
  });
}
