/** Download of a map with its parameters, and the addresses by which robots fetch it. */
import { Download } from "lucide-preact";
import { useRef, useState } from "preact/hooks";
import { type ApiError, apiPath, asApiError, isAbort } from "../../api/client";
import { type Job, requestWithJob } from "../../api/jobs";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { CopyField } from "../../ui/copy-field";
import { JobProgress } from "../../ui/job-progress";
import type { Value } from "../../ui/schema-values";
import { Problem } from "../../ui/states";
import { bytes } from "../../ui/text";
import { filesText, type TableRow } from "./table";

interface Props {
  site: Site;
  row: TableRow;
  values: Record<string, Value>;
  disabled: boolean;
  onProblem: (error: ApiError | null) => void;
}

export function DownloadPart({ site, row, values, disabled, onProblem }: Props) {
  const [job, setJob] = useState<Job | null>(null);
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<ApiError | null>(null);
  const [done, setDone] = useState("");
  const control = useRef<AbortController | null>(null);
  const fail = (error: ApiError | null) => {
    setProblem(error);
    onProblem(error);
  };
  const start = async () => {
    control.current = new AbortController();
    setBusy(true);
    setDone("");
    fail(null);
    try {
      const path = apiPath(site.path("versions", site.exact, "maps", row.id), values);
      const response = await requestWithJob(path, { signal: control.current.signal, onJob: setJob });
      await response.body?.cancel(); // it is ready: the browser fetches it to disk
      save(path);
      setDone(readyText(response));
    } catch (error) {
      if (!isAbort(error)) fail(asApiError(error));
    } finally {
      setBusy(false);
      setJob(null);
    }
  };
  return (
    <section class="stack" aria-label="Download">
      <div class="download">
        <Button main icon={Download} busy={busy} disabled={disabled} onClick={() => void start()}>
          Download
        </Button>
        <small class="grow">
          {filesText(row.format)}
          {row.format.files.length > 1 && "; several files come as one zip"}
        </small>
      </div>
      {busy && <JobProgress job={job} title="Making the map" onCancel={() => control.current?.abort()} />}
      {done && <p role="status">{done}</p>}
      {problem && <Problem error={problem} retry={() => void start()} />}
      <Addresses site={site} row={row} values={values} />
    </section>
  );
}

function Addresses({ site, row, values }: Pick<Props, "site" | "row" | "values">) {
  const isServed = site.channels.value.some(({ channel, version }) => channel === "production" && version !== null);
  const query = apiPath([], values).split("?")[1];
  const address = `${location.origin}/maps/${encodeURIComponent(site.name)}/${row.id}${query ? `?${query}` : ""}`;
  return (
    <details class="part">
      <summary>Address for robots</summary>
      <div class="stack">
        <CopyField label={`Always the ${isServed ? "production" : "latest"} version`} text={address} />
        <CopyField label="Command line" text={`curl -fOJ -H "Authorization: Bearer $FLEETMAP_TOKEN" "${address}"`} />
      </div>
    </details>
  );
}

function save(path: string): void {
  const anchor = document.createElement("a");
  anchor.href = path;
  anchor.download = "";
  document.body.append(anchor);
  anchor.click();
  anchor.remove();
}

function readyText(response: Response): string {
  const name = /filename="([^"]+)"/.exec(response.headers.get("content-disposition") ?? "")?.[1] ?? "The map";
  const size = Number(response.headers.get("content-length"));
  return `${name}${size ? `, ${bytes(size)},` : ""} is on its way to your downloads.`;
}
