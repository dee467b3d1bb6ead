/** Where files are chosen or dropped. For a newcomer it says what works. */
import { FilePlus, FolderPlus, Upload } from "lucide-preact";
import { useRef } from "preact/hooks";
import type { Schemas } from "../../api/client";
import { Button } from "../../ui/button";
import type { Desk } from "./desk";

const EXAMPLES: [string, string][] = [
  ["Grid map", "map.yaml with its image (ROS, Nav2)"],
  ["Building", "a .building.yaml with its floor plans (Open-RMF)"],
  ["Network", "tmap2, navgraph, LIF or Nav2 route graph"],
  ["Drawing", "KML, KMZ or GeoJSON; OpenStreetMap"],
  ["Point cloud, picture", "PCD, PLY, LAS; GeoTIFF"],
  ["All at once", "the folder of an environment_template, or its zip"],
];

interface Props {
  desk: Desk;
  formats: Schemas["FormatOut"][];
  isFirst: boolean;
  hasFiles: boolean;
}

export function DropZone({ desk, formats, isFirst, hasFiles }: Props) {
  return (
    <section class={hasFiles ? "drop-zone small" : "drop-zone"} aria-label="Choose files">
      {!hasFiles && (
        <>
          <Upload size={28} aria-hidden="true" />
          <p class="empty-title">{isFirst ? "Drop this site’s first map here" : "Drop map files here"}</p>
          <p class="muted">Files of one map go together. Nothing is saved until you commit.</p>
        </>
      )}
      <div class="actions">
        <Picker desk={desk} label={hasFiles ? "Add files" : "Choose files"} main={!hasFiles} />
        <Picker desk={desk} label={hasFiles ? "Add folder" : "Choose folder"} folder />
      </div>
      {!hasFiles && (
        <>
          <ul class="examples">
            {EXAMPLES.map(([title, text]) => (
              <li key={title}>
                <b>{title}</b> {text}
              </li>
            ))}
          </ul>
          {formats.length > 0 && (
            <details>
              <summary>All {formats.length} formats that can be read</summary>
              <ul class="format-list">
                {formats.map(({ id, title, files }) => (
                  <li key={id}>
                    {title} <code>{files.join(", ")}</code>
                  </li>
                ))}
              </ul>
            </details>
          )}
        </>
      )}
    </section>
  );
}

function Picker({ desk, label, folder, main }: { desk: Desk; label: string; folder?: boolean; main?: boolean }) {
  const input = useRef<HTMLInputElement>(null);
  return (
    <>
      <input
        ref={(element) => {
          input.current = element;
          if (element && folder) element.webkitdirectory = true;
        }}
        type="file"
        multiple
        hidden
        aria-label={label}
        onChange={(event) => {
          const list = [...(event.currentTarget.files ?? [])];
          desk.add(list.map((file) => ({ path: file.webkitRelativePath || file.name, file })));
          event.currentTarget.value = ""; // the same file may be chosen again
        }}
      />
      <Button main={main} icon={folder ? FolderPlus : FilePlus} onClick={() => input.current?.click()}>
        {label}
      </Button>
    </>
  );
}
