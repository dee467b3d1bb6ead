/** What keys and buttons do with the selection. The keys are those of JOSM. */
import { isEdge, isNode, keyOf } from "./draft";
import type { Editor } from "./editor";
import * as operations from "./operations";
import { withoutVertex } from "./tools/select";
import { Transaction } from "./transaction";

export interface Action {
  id: string;
  title: string;
  key: string;
  /** Whether it makes sense for what is selected. */
  fits: (editor: Editor) => boolean;
  run: (editor: Editor) => void;
}

const lanes = (editor: Editor) => editor.selected.peek().filter(isEdge);
const nodes = (editor: Editor) => editor.selected.peek().filter(isNode);
const streets = (editor: Editor) => {
  const chosen = editor.selected.value.filter(isEdge);
  return chosen.filter((lane) => {
    const twin = editor.draft.twinOf(lane);
    return !twin || lane.id < twin.id || !chosen.some((other) => other === twin);
  });
};

/** Selects what a command has put, so that the next operation goes on with it. */
function replaceSelection(editor: Editor, outcome: operations.Outcome): void {
  const put = typeof outcome === "object" ? outcome.edits.filter(({ to }) => to).map(({ key }) => key) : [];
  editor.run(outcome, put);
}

export const ACTIONS: Action[] = [
  {
    id: "delete",
    title: "Delete",
    key: "Delete",
    fits: (editor) => editor.selected.value.length > 0,
    run: (editor) => {
      const vertex = editor.vertex.peek();
      const selected = editor.selected.peek();
      const command = vertex && withoutVertex(selected, new Transaction(editor.draft), vertex.outline, vertex.index);
      if (command) {
        editor.run(command);
        editor.vertex.value = null;
      } else if (selected.length) editor.run(operations.remove(editor.draft, selected), []);
    },
  },
  {
    id: "split",
    title: "Split in the middle",
    key: "P",
    fits: (editor) => streets(editor).length === 1,
    run: (editor) => {
      const command = operations.split(editor.draft, lanes(editor));
      const node = typeof command === "object" ? command.edits.find(({ to }) => isNode(to))?.to : null;
      editor.run(command, node ? [keyOf(node)] : undefined);
    },
  },
  {
    id: "merge",
    title: "Merge nodes",
    key: "M",
    fits: (editor) => editor.selected.value.filter(isNode).length > 1,
    run: (editor) => {
      const first = nodes(editor).at(-1);
      const ordered = first ? [first, ...nodes(editor).filter((node) => node !== first)] : [];
      editor.run(operations.merge(editor.draft, ordered), first ? [keyOf(first)] : undefined);
    },
  },
  {
    id: "connect",
    title: "Connect nodes",
    key: "C",
    fits: (editor) => editor.selected.value.filter(isNode).length > 1,
    run: (editor) => {
      const chain = nodes(editor);
      const edits = new Transaction(editor.draft);
      chain.slice(1).forEach((node, index) => {
        const from = chain[index];
        if (!from) return;
        if (!edits.edgesBetween(from, node).length) edits.addEdge(from, node);
        if (!editor.options.peek().oneWay && !edits.edgesBetween(node, from).length) edits.addEdge(node, from);
      });
      editor.run(edits.edits().length ? edits.command("Connect") : "These nodes are connected already");
    },
  },
  {
    id: "reverse",
    title: "Reverse",
    key: "R",
    fits: (editor) => editor.selected.value.some((lane) => isEdge(lane) && !editor.draft.twinOf(lane)),
    run: (editor) => replaceSelection(editor, operations.reverse(editor.draft, lanes(editor))),
  },
  {
    id: "one-way",
    title: "Make one-way",
    key: "T",
    fits: (editor) => editor.selected.value.some((lane) => isEdge(lane) && editor.draft.twinOf(lane) !== undefined),
    run: (editor) => {
      const kept = editor.selected.peek();
      editor.run(operations.makeOneWay(editor.draft, lanes(editor)), kept.map(keyOf));
    },
  },
  {
    id: "two-way",
    title: "Make two-way",
    key: "T",
    fits: (editor) => {
      const chosen = editor.selected.value.filter(isEdge);
      return chosen.length > 0 && chosen.every((lane) => !editor.draft.twinOf(lane));
    },
    run: (editor) => {
      const command = operations.makeTwoWay(editor.draft, lanes(editor));
      const added = typeof command === "object" ? command.edits.map(({ key }) => key) : [];
      editor.run(command, [...editor.selection.peek(), ...added]);
    },
  },
  {
    id: "align",
    title: "Align in line",
    key: "L",
    fits: (editor) => operations.nodesOf(editor.draft, editor.selected.value).length > 2,
    run: (editor) => editor.run(operations.align(editor.draft, editor.selected.peek())),
  },
  {
    id: "straighten",
    title: "Straighten",
    key: "Shift+L",
    fits: (editor) => editor.selected.value.some(isEdge),
    run: (editor) => editor.run(operations.straighten(editor.draft, editor.selected.peek())),
  },
  {
    id: "distribute",
    title: "Space evenly",
    key: "Shift+B",
    fits: (editor) => operations.nodesOf(editor.draft, editor.selected.value).length > 2,
    run: (editor) => editor.run(operations.distribute(editor.draft, editor.selected.peek())),
  },
  {
    id: "square",
    title: "Square up",
    key: "Q",
    fits: (editor) =>
      editor.selected.value.some(
        ({ geometry }) => geometry.type === "Polygon" && (geometry.coordinates[0]?.length ?? 0) > 4,
      ),
    run: (editor) => editor.run(operations.squareUp(editor.draft, editor.selected.peek())),
  },
  {
    id: "all",
    title: "Select all",
    key: "Ctrl+A",
    fits: () => true,
    run: (editor) => {
      const level = editor.site.level.peek();
      editor.select(
        editor.draft
          .features()
          .filter((feature) => feature.level === level && feature.layer === "topology")
          .map(keyOf),
      );
    },
  },
  {
    id: "copy",
    title: "Copy",
    key: "Ctrl+C",
    fits: (editor) => editor.selected.value.length > 0,
    run: (editor) => {
      editor.copied = editor.selected.peek();
    },
  },
  {
    id: "paste",
    title: "Paste",
    key: "Ctrl+V",
    fits: (editor) => editor.copied.length > 0,
    run: (editor) => {
      if (!editor.copied.length) return;
      const step = 30 * editor.map.resolution.peek();
      const command = operations.paste(editor.draft, editor.copied, step, -step, editor.site.level.peek());
      editor.run(
        command,
        command.edits.map(({ key }) => key),
      );
    },
  },
  {
    id: "zoom",
    title: "Zoom to the selection",
    key: "3",
    fits: (editor) => editor.selected.value.length > 0,
    run: (editor) => {
      if (editor.selected.peek().length) editor.map.fitFeatures(editor.selected.peek());
    },
  },
  { id: "undo", title: "Undo", key: "Ctrl+Z", fits: () => true, run: (editor) => editor.undo() },
  { id: "redo", title: "Redo", key: "Ctrl+Y", fits: () => true, run: (editor) => editor.redo() },
];

/** Moves the selection by the arrow keys. */
export function nudge(editor: Editor, dx: number, dy: number): void {
  const { snap } = editor.options.peek();
  const step = snap.grid ? snap.step : 10 ** Math.round(Math.log10(4 * editor.map.resolution.peek()));
  const selected = editor.selected.peek();
  if (selected.length) editor.run(operations.move(editor.draft, selected, dx * step, dy * step));
}

export function actionFor(editor: Editor, key: string): Action | undefined {
  const candidates = ACTIONS.filter((action) => action.key === key);
  return candidates.find((action) => action.fits(editor)) ?? candidates[0];
}
