/** A repair: tried first and drawn on the map, then committed as exactly that. */
import { ArrowLeft, RefreshCw } from "lucide-preact";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { go } from "../../address";
import {
  type ApiError,
  api,
  apiPath,
  asApiError,
  ask,
  type DryRun,
  requestJson,
  type Schemas,
  type Version,
} from "../../api/client";
import { useLoaded } from "../../api/loaded";
import type { Finding } from "../../checks";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { Problem, Show } from "../../ui/states";
import { count } from "../../ui/text";
import { notify } from "../../ui/toast";
import { Changes, useDiff } from "../upload/result";
import { combineFixes } from "./fixes";

interface Props {
  site: Site;
  map: SiteMap;
  findings: Finding[];
  onClose: () => void;
}

export function FixPanel({ site, map, findings, onClose }: Props) {
  const batch = useMemo(() => combineFixes(findings), [findings]);
  const [first] = batch.findings;
  const title = first?.fix?.title ?? "";
  const message = batch.findings.length === 1 ? title : `${title} (${batch.findings.length} findings)`;
  const heading = useRef<HTMLHeadingElement>(null);
  useEffect(() => heading.current?.focus(), []);
  const tried = useLoaded(
    async (signal) => {
      const params = { path: { env: site.name, v: "latest" } };
      const head = (await ask(api.GET("/api/v1/environments/{env}/versions/{v}", { params, signal }))) as Version;
      const body: Schemas["EditsBody"] = { changes: batch.edits, message, dry_run: true };
      const dry = await requestJson<DryRun>(apiPath(site.path("edits")), {
        method: "POST",
        headers: { "Content-Type": "application/json", "If-Match": `"${head.version}"` },
        body: JSON.stringify(body),
        signal,
      });
      return { dry, key: crypto.randomUUID?.() ?? `${Date.now()}-${Math.random()}` };
    },
    [batch],
  );
  return (
    <section class="stack fix" aria-label="Repair">
      <Button quiet icon={ArrowLeft} onClick={onClose}>
        Back to the findings
      </Button>
      <h2 tabIndex={-1} ref={heading}>
        {title}
      </h2>
      <ul class="fix-list">
        {batch.findings.slice(0, 5).map((finding, index) => (
          <li key={index}>{finding.detail}</li>
        ))}
        {batch.findings.length > 5 && <li>… and {count(batch.findings.length - 5, "more finding")}</li>}
      </ul>
      {batch.later > 0 && (
        <p class="note">
          {count(batch.later, "repair")} of the same features {batch.later === 1 ? "is" : "are"} left for afterwards:
          the first ones change what they are about.
        </p>
      )}
      <Show of={tried}>
        {({ dry, key }) => (
          <Apply
            key={dry.id}
            site={site}
            map={map}
            dry={dry}
            idempotency={key}
            onAgain={tried.reload}
            onClose={onClose}
          />
        )}
      </Show>
    </section>
  );
}

interface ApplyProps {
  site: Site;
  map: SiteMap;
  dry: DryRun;
  idempotency: string;
  onAgain: () => void;
  onClose: () => void;
}

function Apply({ site, map, dry, idempotency, onAgain, onClose }: ApplyProps) {
  const diff = useDiff(map, dry.parent, dry.id);
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<ApiError | null>(null);
  const apply = async () => {
    setBusy(true);
    setProblem(null);
    try {
      const version = await requestJson<Version>(apiPath(site.path("versions")), {
        method: "POST",
        headers: {
          "Content-Type": "application/json",
          "If-Match": `"${dry.parent}"`,
          "Idempotency-Key": idempotency,
        },
        body: JSON.stringify({ commit: dry.id }),
      });
      notify(`v${version.version} committed: ${version.message}`);
      await site.refresh();
      if (site.number !== version.version) go({ version: version.version }, { replace: true });
      onClose();
    } catch (error) {
      setProblem(asApiError(error));
      setBusy(false);
    }
  };
  const isOld = problem?.status === 412 || problem?.status === 404;
  return (
    <>
      <Changes map={map} diff={diff} changes={dry.diff.layers as Record<string, unknown>} />
      {problem && <Problem error={problem} />}
      <div class="actions">
        {isOld && (
          <Button icon={RefreshCw} onClick={onAgain}>
            Try on the latest version
          </Button>
        )}
        <Button main busy={busy} disabled={isOld} onClick={() => void apply()}>
          Fix: commit as v{dry.parent + 1}
        </Button>
      </div>
    </>
  );
}
