/** Restore a version: first what this would change, then a new version with its content. */
import { useEffect, useState } from "preact/hooks";
import { go } from "../../address";
import { type DryRun, requestJson, apiPath, type Version } from "../../api/client";
import { useLoaded } from "../../api/loaded";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { Dialog } from "../../ui/dialog";
import { Show } from "../../ui/states";
import { attempt, notify } from "../../ui/toast";
import { changesInWords } from "./words";

interface Props {
  site: Site;
  /** Version to restore; null: closed. */
  version: number | null;
  onClose: () => void;
}

export function RestoreDialog({ site, version, onClose }: Props) {
  const [message, setMessage] = useState("");
  const [busy, setBusy] = useState(false);
  const head = site.environment.value?.version;
  const dryRun = useLoaded(
    async (signal) => (version === null ? null : askDryRun(site, version, signal)),
    [site.name, version, head],
  );
  useEffect(() => setMessage(version === null ? "" : `Restore v${version}`), [version]);
  const run = dryRun.data ?? null;
  const isSame = run !== null && run.version !== null;
  const commit = async () => {
    if (run === null || run.version !== null) return;
    setBusy(true);
    const made = await attempt(() => commitRun(site, run, message));
    setBusy(false);
    if (!made) {
      dryRun.reload();
      return;
    }
    onClose();
    notify(`Version ${version} is restored as v${made.version}`, {
      action: { label: "Promote…", run: () => go({ promote: made.version }) },
    });
    go({ from: null, to: null, change: null, version: made.version });
    await site.refresh();
  };
  return (
    <Dialog
      open={version !== null}
      title={`Restore version ${version}`}
      onClose={onClose}
      actions={
        <>
          <Button onClick={onClose}>Cancel</Button>
          <Button main busy={busy} disabled={run === null || isSame || dryRun.loading} onClick={() => void commit()}>
            Restore as a new version
          </Button>
        </>
      }
    >
      <p>A new version with the content of v{version}. No version is lost; no channel moves.</p>
      <Show of={dryRun}>
        {(found) =>
          isSame || !found ? (
            <p class="note">The latest version has this content already.</p>
          ) : (
            <section>
              <h3>What this changes in the latest version, v{head}</h3>
              <ul class="plain-list">
                {changesInWords(found.changes).map((text) => (
                  <li key={text}>{text}</li>
                ))}
              </ul>
              <Button
                quiet
                onClick={() => {
                  onClose();
                  go({ from: String(head), to: found.version === null ? found.id : found.version });
                }}
              >
                Look at it on the map first
              </Button>
            </section>
          )
        }
      </Show>
      <label class="field">
        <span>Message</span>
        <input
          type="text"
          value={message}
          maxLength={20000}
          onInput={(event) => setMessage(event.currentTarget.value)}
        />
      </label>
    </Dialog>
  );
}

/** Returns the version that would be made; a version with a number if nothing would change. */
async function askDryRun(site: Site, version: number, signal: AbortSignal): Promise<DryRun | Version> {
  return requestJson(apiPath(site.path("versions")), {
    method: "POST",
    headers: { "content-type": "application/json" },
    body: JSON.stringify({ revert_to: version, dry_run: true }),
    signal,
  });
}

export async function commitRun(site: Site, run: DryRun, message: string): Promise<Version> {
  return requestJson(apiPath(site.path("versions")), {
    method: "POST",
    headers: { "content-type": "application/json", "idempotency-key": `commit ${run.id}` },
    body: JSON.stringify({ commit: run.id, message }),
  });
}
