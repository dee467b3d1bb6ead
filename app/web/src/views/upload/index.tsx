/**
 * Upload: files are chosen, tried (a dry run, drawn on the map) and committed as one version.
 *
 * Address: `version=dry:…` while a dry run is shown.
 */
import { effect } from "@preact/signals";
import { RotateCcw } from "lucide-preact";
import { useEffect } from "preact/hooks";
import { api, ask, online } from "../../api/client";
import { useLoaded } from "../../api/loaded";
import { dropped } from "../../dropped";
import { expired } from "../../session";
import { Button } from "../../ui/button";
import { Problem } from "../../ui/states";
import type { ViewProps } from "../registry";
import { deskOf, leaveDryRun, showDryRun } from "./desk";
import { Done } from "./done";
import { DropZone } from "./drop-zone";
import { FileList } from "./file-list";
import { Options } from "./options";
import { Newer, Result } from "./result";
import { Sending, Waiting } from "./sending";
import "./upload.css";

export default function UploadView({ site, map }: ViewProps) {
  const desk = deskOf(site);
  const formats = useLoaded((signal) => ask(api.GET("/api/v1/formats", { signal })), []);
  const readable = (formats.data ?? []).filter(({ read }) => read);
  useEffect(
    () =>
      effect(() => {
        const files = dropped.value;
        if (!files.length) return;
        dropped.value = [];
        desk.add(files);
      }),
    [desk],
  );
  useEffect(() => {
    const step = desk.step.peek();
    if (step.name === "tried" || step.name === "waiting") showDryRun(step.dry);
    else leaveDryRun();
    return leaveDryRun;
  }, [desk]);
  useEffect(
    () =>
      effect(() => {
        if (online.value && desk.step.peek().name === "waiting") void desk.commit();
      }),
    [desk],
  );
  useEffect(() => {
    const warn = (event: BeforeUnloadEvent) => {
      if (desk.step.peek().name === "waiting") event.preventDefault(); // the browser asks before it closes the page
    };
    addEventListener("beforeunload", warn);
    return () => removeEventListener("beforeunload", warn);
  }, [desk]);
  useEffect(
    () =>
      effect(() => {
        // Who has signed in again is not told that a token is required.
        if (!expired.value && desk.problem.peek()?.status === 401) desk.problem.value = null;
      }),
    [desk],
  );
  useEffect(() => effect(() => void desk.watchHead(site.environment.value?.version)), [desk, site]);
  const step = desk.step.value;
  const files = desk.files.value;
  if (step.name === "done") return <Done desk={desk} version={step.version} isNew={step.isNew} />;
  const isEmptySite = site.environment.value?.version === 0;
  const isTried = step.name === "tried" || step.name === "waiting";
  return (
    <form
      class="stack upload"
      onSubmit={(event) => {
        event.preventDefault();
        void (isTried ? desk.commit() : desk.tryFiles());
      }}
    >
      <DropZone
        desk={desk}
        formats={readable}
        isFirst={isEmptySite && files.length === 0}
        hasFiles={files.length > 0}
      />
      {files.length > 0 && (
        <>
          <FileList desk={desk} dry={isTried ? step.dry : null} />
          <Options desk={desk} site={site} formats={readable} dry={isTried ? step.dry : null} />
          {desk.newer.value ? (
            <Newer desk={desk} version={desk.newer.value} />
          ) : (
            desk.problem.value && <Problem error={desk.problem.value} />
          )}
          {isTried && <Result key={step.dry.id} site={site} map={map} dry={step.dry} />}
          {step.name === "sending" && <Sending desk={desk} step={step} />}
          {step.name === "waiting" && <Waiting desk={desk} />}
          {(step.name === "choose" || step.name === "tried") && (
            <>
              {isTried && <Message value={desk.message.value} onInput={(text) => (desk.message.value = text)} />}
              <div class="actions upload-actions">
                <Button quiet icon={RotateCcw} onClick={() => desk.reset()}>
                  Start over
                </Button>
                <span class="spacer" />
                {isTried ? (
                  <Button main type="submit" disabled={Boolean(desk.newer.value)}>
                    Commit as v{step.dry.parent + 1}
                  </Button>
                ) : (
                  <Button main type="submit" disabled={!online.value}>
                    Try
                  </Button>
                )}
              </div>
              {!isTried && (
                <p class="muted">Try shows on the map what these files would change. It saves nothing yet.</p>
              )}
            </>
          )}
        </>
      )}
    </form>
  );
}

function Message({ value, onInput }: { value: string; onInput: (text: string) => void }) {
  return (
    <label class="field">
      <span>Message</span>
      <textarea
        value={value}
        maxLength={2000}
        rows={2}
        placeholder="Why this changes, for the history"
        onInput={(event) => onInput(event.currentTarget.value)}
      />
    </label>
  );
}
