/** The version is saved: where to go from here. */
import { CircleCheck, GitCompare, Eye, Rocket, Upload } from "lucide-preact";
import { useEffect, useRef } from "preact/hooks";
import { go, link } from "../../address";
import type { Version } from "../../api/client";
import { Button } from "../../ui/button";
import { Findings } from "../../ui/states";
import { count } from "../../ui/text";
import { open } from "../sites";
import type { Desk } from "./desk";

export function Done({ desk, version, isNew }: { desk: Desk; version: Version; isNew: boolean }) {
  const top = useRef<HTMLDivElement>(null);
  useEffect(() => top.current?.focus(), []); // the button that was pressed is gone
  const links = [
    { text: "Show on the map", icon: Eye, to: { view: "layers", version: version.version } },
    {
      text: "Compare with before",
      icon: GitCompare,
      to: { view: "history", from: version.parent, to: version.version, version: null },
    },
    {
      text: "Promote to robots",
      icon: Rocket,
      to: { view: "history", version: version.version, promote: version.version },
    },
  ];
  return (
    <div class="stack">
      <div class="done" role="status" tabIndex={-1} ref={top}>
        <CircleCheck size={28} aria-hidden="true" />
        <p class="empty-title">
          {isNew ? `v${version.version} committed` : `Nothing changed: v${version.version} already has this content`}
        </p>
        <p class="muted">
          {isNew
            ? version.message || "No message"
            : "The files are kept as further sources of that version; no new one was made."}
        </p>
      </div>
      <ul class="next">
        {(isNew ? links : links.slice(0, 1)).map(({ text, icon: Icon, to }) => (
          <li key={text}>
            <a class="button" href={link(to)} onClick={open(() => go(to))}>
              <Icon size={18} aria-hidden="true" /> {text}
            </a>
          </li>
        ))}
      </ul>
      {version.warnings.length > 0 && (
        <details>
          <summary>{count(version.warnings.length, "warning")}, kept with the version</summary>
          <Findings items={version.warnings} />
        </details>
      )}
      <Button icon={Upload} onClick={() => desk.reset()}>
        Upload more
      </Button>
    </div>
  );
}
