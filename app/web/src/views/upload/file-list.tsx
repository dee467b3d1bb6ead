/** The chosen files, with what the server found them to be. */
import { X } from "lucide-preact";
import type { DryRun } from "../../api/client";
import { Button } from "../../ui/button";
import { bytes, count } from "../../ui/text";
import type { Desk } from "./desk";
import { totalSize } from "./files";

const SHOWN = 200;

export function FileList({ desk, dry }: { desk: Desk; dry: DryRun | null }) {
  const files = desk.files.value;
  const found = new Map((dry?.sources ?? []).map((source) => [source.name, source]));
  const isBusy = desk.step.value.name === "sending";
  return (
    <section aria-label="Files">
      <h2>
        {count(files.length, "file")} <span class="muted">{bytes(totalSize(files))}</span>
      </h2>
      <ul class="file-list">
        {files.slice(0, SHOWN).map(({ path, file }) => {
          const source = found.get(path);
          return (
            <li key={path}>
              <span class="grow">
                {path}
                {source && (
                  <small>
                    {source.used ? (source.format ?? "part of the map") : "not used; kept with the version"}
                  </small>
                )}
              </span>
              <small>{bytes(file.size)}</small>
              <Button quiet icon={X} label={`Remove ${path}`} disabled={isBusy} onClick={() => desk.remove(path)} />
            </li>
          );
        })}
      </ul>
      {files.length > SHOWN && <p class="muted">… and {count(files.length - SHOWN, "more file")}</p>}
      {desk.hidden.value > 0 && <p class="muted">{count(desk.hidden.value, "hidden file")} left out.</p>}
    </section>
  );
}
