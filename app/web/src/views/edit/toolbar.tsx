/** The tools, over the map. */
import {
  BoxSelect,
  Brush,
  CircleHelp,
  Fence,
  Grid3x3,
  ListPlus,
  Magnet,
  MousePointer2,
  Octagon,
  Redo2,
  Scissors,
  Shapes,
  Undo2,
  Waypoints,
} from "lucide-preact";
import { Button } from "../../ui/button";
import type { Desk } from "./desk";
import type { ToolName } from "./options";

const TOOLS = [
  { name: "select", title: "Select and move (S)", icon: MousePointer2 },
  { name: "path", title: "Draw lanes (A)", icon: Waypoints },
  { name: "split", title: "Split lanes (X)", icon: Scissors },
  { name: "zone", title: "Draw a zone (Z)", icon: Octagon },
  { name: "object", title: "Draw an object (O)", icon: Shapes },
  { name: "fence", title: "Draw the fence (F)", icon: Fence },
  { name: "cells", title: "Set cells in an area (C)", icon: Grid3x3 },
  { name: "brush", title: "Paint cells (B)", icon: Brush },
] satisfies { name: ToolName; title: string; icon: unknown }[];

export function Toolbar({ desk }: { desk: Desk }) {
  const { editor } = desk;
  const options = editor.options.value;
  const hasGrid = editor.site.rasters.value.some(({ layer }) => layer === "occupancy");
  editor.revision.value;
  const { position, log } = editor.draft;
  return (
    <div class="edit-toolbar" role="toolbar" aria-label="Editing tools" aria-orientation="vertical">
      <div class="edit-tools">
        {TOOLS.filter(({ name }) => hasGrid || (name !== "cells" && name !== "brush")).map(({ name, title, icon }) => (
          <Button
            key={name}
            icon={icon}
            label={title}
            pressed={editor.tool.value === name}
            onClick={() => editor.setTool(name)}
          />
        ))}
      </div>
      <div class="edit-tools">
        <Button icon={Undo2} label="Undo (Ctrl+Z)" disabled={position === 0} onClick={() => editor.undo()} />
        <Button icon={Redo2} label="Redo (Ctrl+Y)" disabled={position === log.length} onClick={() => editor.redo()} />
        <Button
          icon={BoxSelect}
          label="Select by a box (Shift and drag)"
          pressed={options.box}
          onClick={() => {
            editor.setTool("select");
            editor.set({ box: !options.box });
          }}
        />
        <Button
          icon={ListPlus}
          label="Select several (Shift and click)"
          pressed={options.several}
          onClick={() => editor.set({ several: !options.several })}
        />
        <Button
          icon={Magnet}
          label={options.free ? "Snapping is off" : "Snapping is on (hold Alt to release)"}
          pressed={!options.free}
          onClick={() => editor.set({ free: !options.free })}
        />
        <Button
          icon={CircleHelp}
          label="Keys (?)"
          onClick={() => {
            desk.help.value = true;
          }}
        />
      </div>
    </div>
  );
}
