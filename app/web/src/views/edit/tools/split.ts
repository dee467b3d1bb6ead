/** Split lanes by clicks on them. */
import { isEdge, keyOf } from "../draft";
import { split } from "../operations";
import { mark, marksOf } from "../sketch";
import { snap } from "../snap";
import { type Press, Tool } from "./tool";

export class SplitTool extends Tool {
  private at(press: Press) {
    const options = { nodes: true, edges: true, angles: false, grid: false, step: 0 };
    const snapped = snap(press.at, options, { near: press.hits, reach: press.reach });
    return snapped.kind === "edge" && isEdge(snapped.feature) ? { lane: snapped.feature, snapped } : null;
  }

  override move(press: Press): void {
    const found = this.at(press);
    this.context.sketch.marks.value = found ? [mark("edge", found.lane.geometry), ...marksOf(found.snapped)] : [];
  }

  override click(press: Press): void {
    const found = this.at(press);
    if (!found) {
      this.editor.run("Click on a lane, away from its ends, to split it there");
      return;
    }
    const { editor } = this;
    const lanes = editor
      .wholeOf(found.lane)
      .map((key) => editor.draft.get(key))
      .filter((lane) => lane !== undefined);
    const command = split(editor.draft, lanes, found.snapped.at);
    const node = typeof command === "object" ? command.edits.find(({ from }) => !from)?.to : null;
    editor.run(command, node ? [keyOf(node)] : []);
  }
}
