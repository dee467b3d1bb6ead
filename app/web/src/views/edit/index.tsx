/** Edit: draw and repair the network, zones, objects, the fence and cells, and save it as one version.
 *
 * Address: `tool` is the tool in use, `feature` the id of the selected feature. While the view is open, `version` is
 * `latest`, as edits build on the newest version; or `draft:…`, and they are saved in that draft. */
import { Redo2, Undo2, X } from "lucide-preact";
import { createPortal } from "preact/compat";
import { useEffect, useState } from "preact/hooks";
import { go, param } from "../../address";
import { online } from "../../api/client";
import { can } from "../../session";
import { Button } from "../../ui/button";
import { Bars, Empty } from "../../ui/states";
import { count } from "../../ui/text";
import { attempt } from "../../ui/toast";
import type { ViewProps } from "../registry";
import { Checks } from "./checks";
import { Conflicts } from "./conflicts";
import { Desk } from "./desk";
import "./edit.css";
import type { Editor } from "./editor";
import { Keys } from "./keys";
import { DraftList } from "./list";
import { Review } from "./review";
import { Selection } from "./selection";
import { SnapSettings } from "./snap-settings";
import { targetOf } from "./target";
import { ToolOptions } from "./tool-options";
import { Toolbar } from "./toolbar";

export default function EditView({ site, map }: ViewProps) {
  const [desk, setDesk] = useState<Desk | null>(null);
  const target = targetOf(param("version"));
  useEffect(() => {
    const before = param("version");
    if (before !== target) go({ version: target }, { replace: true });
    const made = new Desk(site, map, target);
    setDesk(made);
    return () => {
      made.close();
      setDesk(null);
      const left = target === "latest" && param("version") === "latest" ? { version: before } : {};
      go({ tool: null, ...left }, { replace: true });
    };
  }, [site, map, target]);
  if (!can("editor")) {
    return (
      <Empty title="You may look at this map, not change it">
        <p>Sign in with a token of an editor or administrator to edit.</p>
      </Empty>
    );
  }
  if (!desk || !desk.editor.ready.value) return <Bars />;
  return <Panel desk={desk} />;
}

function Panel({ desk }: { desk: Desk }) {
  const { editor, map } = desk;
  const pending = editor.head.pending.value;
  const area = map.map.getTargetElement()?.parentElement;
  return (
    <div class="edit-panel">
      <Status desk={desk} />
      <Notes editor={editor} />
      {pending ? (
        <Conflicts editor={editor} pending={pending} />
      ) : (
        <>
          <ToolOptions desk={desk} />
          <Selection editor={editor} />
          <Checks editor={editor} />
          <SnapSettings editor={editor} />
          <DraftList editor={editor} />
        </>
      )}
      {area && !pending && createPortal(<Toolbar desk={desk} />, area)}
      <Review desk={desk} />
      <Keys desk={desk} />
    </div>
  );
}

function Status({ desk }: { desk: Desk }) {
  const { editor } = desk;
  const total = editor.count.value;
  editor.revision.value;
  const { position, log } = editor.draft;
  const stored = { kept: "kept on this device", saving: "being kept …", failed: "not kept: the device has no room" };
  return (
    <header class="edit-status">
      <p class="grow" role="status">
        <b>{total ? count(total, "change") : "No changes"}</b>
        <small>
          {editor.target.draft === null ? "on" : "in"} {editor.target.words(editor.base.value)}
          {total > 0 && ` · ${stored[editor.stored.value]}`}
          {!online.value && " · offline"}
        </small>
        <span class="visually-hidden">{editor.lastStep.value}</span>
      </p>
      <Button quiet icon={Undo2} label="Undo" disabled={position === 0} onClick={() => editor.undo()} />
      <Button quiet icon={Redo2} label="Redo" disabled={position === log.length} onClick={() => editor.redo()} />
      <Button
        main
        disabled={total === 0 && editor.target.draft === null}
        onClick={() => {
          desk.review.value = true;
        }}
      >
        Review
      </Button>
    </header>
  );
}

function mergeNow(editor: Editor): void {
  if (editor.refuse()) return;
  void attempt(() => editor.whileSending(async () => void (await editor.head.merge(null))));
}

function Notes({ editor }: { editor: Editor }) {
  const partial = editor.site.partial.value;
  return (
    <>
      {editor.notes.value.map(({ id, text, details }) => (
        <div key={id} class="note edit-note" role="status">
          <p class="grow">
            {text}
            {details?.map((detail) => (
              <small key={detail}>{detail}</small>
            ))}
          </p>
          {id === "moved" && <Button onClick={() => mergeNow(editor)}>Merge now</Button>}
          <Button quiet icon={X} label="Dismiss" onClick={() => editor.dismiss(id)} />
        </div>
      ))}
      {partial.length > 0 && (
        <p class="note" role="note">
          Too many features to load at once ({partial.join(", ")}): you edit what is in the visible part of the map.
        </p>
      )}
    </>
  );
}
