/** Draw lanes in a chain: a click in the void makes a node and a lane to it. */
import type { Feature, Position } from "../../../map/features";
import { isEdge, isNode, keyOf, same } from "../draft";
import { splitInto } from "../operations";
import { mark, marksOf } from "../sketch";
import type { Snapped } from "../snap";
import { placeOf, Transaction } from "../transaction";
import { type Press, Tool } from "./tool";

export class PathTool extends Tool {
  /** Keys of the nodes drawn, first to last. */
  private chain: string[] = [];

  /** The node that the next lane starts at; undo may have taken later ones. */
  private get last(): Feature | undefined {
    while (this.chain.length) {
      const node = this.editor.draft.get(this.chain.at(-1) ?? "");
      if (node) return node;
      this.chain.pop();
    }
    return undefined;
  }

  /** Starts the next chain at a node. */
  startAt(node: Feature): void {
    this.chain = [keyOf(node)];
  }

  private snapped(press: Press): Snapped {
    const { last } = this;
    const from = last && (placeOf(last).slice(0, 2) as Position);
    const previous = this.editor.draft.get(this.chain.at(-2) ?? "");
    const before = previous && (placeOf(previous).slice(0, 2) as Position);
    return this.snap(press, { from, before });
  }

  override move(press: Press): void {
    const snapped = this.snapped(press);
    const { last } = this;
    const line = last ? [mark("line", { type: "LineString", coordinates: [placeOf(last), [...snapped.at]] })] : [];
    this.context.sketch.marks.value = [...line, ...marksOf(snapped)];
  }

  override click(press: Press): void {
    this.add(this.snapped(press));
    this.move(press);
  }

  /** Adds a point at exact metres. */
  addAt(at: Position): void {
    this.add({ at, kind: "free" });
  }

  private add(snapped: Snapped): void {
    const { editor, last } = this;
    const edits = new Transaction(editor.draft);
    const node = this.nodeAt(edits, snapped);
    if (last && keyOf(last) === keyOf(node)) {
      this.chain = [];
      return;
    }
    const from = last && edits.get(keyOf(last));
    if (from) {
      const { oneWay, likeBefore } = editor.options.peek();
      const properties = likeBefore ? sharedProperties(edits, from) : {};
      if (!edits.edgesBetween(from, node).length) edits.addEdge(from, node, properties);
      if (!oneWay && !edits.edgesBetween(node, from).length) edits.addEdge(node, from, properties);
    }
    const title = !from ? `Start at ${node.id}` : `Lane ${from.id} to ${node.id}`;
    const isNew = !editor.draft.get(keyOf(node));
    this.chain.push(keyOf(node));
    if (isNew || from) editor.run(edits.command(title), [keyOf(node)]);
    else editor.select([keyOf(node)]);
  }

  private nodeAt(edits: Transaction, { feature, kind, at }: Snapped): Feature {
    if (kind === "node" && isNode(feature)) return feature;
    if (kind === "edge" && isEdge(feature)) {
      const lanes = this.editor
        .wholeOf(feature)
        .map((key) => this.editor.draft.get(key))
        .filter((lane) => lane !== undefined);
      const node = splitInto(edits, lanes, at);
      if (typeof node !== "string") return node;
    }
    return edits.addNode(at, this.editor.placeFor("topology"));
  }

  override double(): void {
    this.chain = [];
    this.context.sketch.marks.value = [];
  }

  override finish(): void {
    this.chain = [];
    this.context.sketch.marks.value = [];
  }

  override back(): boolean {
    if (!this.last) return false;
    this.editor.undo();
    return true;
  }

  override cancel(): boolean {
    const isUnderWay = this.chain.length > 0;
    this.finish();
    return isUnderWay;
  }
}

const TAKEN = ["action", "speed_limit", "width", "surface", "access"];

/** Returns what the lanes at a node have in common. */
function sharedProperties(edits: Transaction, node: Feature): Record<string, unknown> {
  const [first, ...others] = edits.edgesOf(node);
  if (!first) return {};
  const names = TAKEN.filter(
    (name) =>
      first.properties[name] !== undefined &&
      others.every(({ properties }) => same(properties[name], first.properties[name])),
  );
  return Object.fromEntries(names.map((name) => [name, first.properties[name]]));
}
