/** Any order of edits keeps lanes tied to their nodes, can be undone, replayed and merged (run by tests/web/test_modules.py). */
import { type Command, Draft, isEdge, isNode, keyOf, same } from "./draft";
import { compare, merged, withFreshIds } from "./merge";
import * as operations from "./operations";
import { placeOf, Transaction } from "./transaction";
import { type Feature, linesOf } from "../../map/features";

const RUNS = 150;
const WHERE = { level: "ground", part: "network" };

let seed = 1;

function random(): number {
  seed = (seed * 1103515245 + 12345) & 0x7fffffff;
  return seed / 0x7fffffff;
}

function pick<T>(list: readonly T[]): T {
  return list[Math.floor(random() * list.length)] as T;
}

function require(condition: boolean, text: string): void {
  if (!condition) throw new Error(text);
}

function network(): Feature[] {
  const draft = new Draft([]);
  const edits = new Transaction(draft);
  const nodes = Array.from({ length: 12 }, () => edits.addNode([random() * 20, random() * 20], WHERE));
  for (let index = 0; index < 16; index++) {
    const [a, b] = [pick(nodes), pick(nodes)];
    if (a === b || edits.edgesBetween(a, b).length) continue;
    edits.addEdge(a, b, {}, random() < 0.3 ? [[1, 2]] : []);
    if (random() < 0.6 && !edits.edgesBetween(b, a).length) edits.addEdge(b, a);
  }
  draft.execute(edits.command("start"));
  return [...draft.features()];
}

function checkTied(draft: Draft, when: string): void {
  for (const edge of draft.features().filter(isEdge)) {
    const [source, target] = [draft.endOf(edge, "source"), draft.endOf(edge, "target")];
    if (!source || !target || edge.geometry.type !== "LineString") throw new Error(`${when}: ${edge.id} dangles`);
    const line = edge.geometry.coordinates;
    const off = (a: number[] = [], b: number[] = []) =>
      Math.hypot((a[0] ?? 0) - (b[0] ?? 0), (a[1] ?? 0) - (b[1] ?? 0));
    require(off(line[0], placeOf(source)) < 1e-6 &&
      off(line.at(-1), placeOf(target)) < 1e-6, `${when}: ${edge.id} is loose`);
    require(draft.edgesOf(source).includes(edge), `${when}: ${edge.id} is not at its node`);
  }
}

function draw(draft: Draft, from: Feature): Command {
  const edits = new Transaction(draft);
  const node = edits.addNode([random() * 20, random() * 20], WHERE);
  edits.addEdge(from, node);
  edits.addEdge(node, from);
  return edits.command("draw");
}

function join(draft: Draft, node: Feature, edge: Feature): Command {
  const edits = new Transaction(draft);
  const lanes = [edge, draft.twinOf(edge)].filter((one) => one !== undefined);
  edits.place(node, ...(operations.middleOf(linesOf(edge.geometry)[0] ?? []) as [number, number]));
  const others = lanes.map((lane) => edits.get(keyOf(lane)) ?? lane);
  if (others.every(({ properties }) => properties.source !== node.id && properties.target !== node.id))
    operations.joinInto(edits, edits.get(keyOf(node)) ?? node, others);
  return edits.command("join");
}

function step(draft: Draft): void {
  const features = [...draft.features()];
  if (!features.length) return;
  const [edges, nodes] = [features.filter(isEdge), features.filter(isNode)];
  const some = [...new Set([pick(features), pick(features), pick(features)])];
  const edge = pick(edges);
  const possible: (() => operations.Outcome)[] = [
    () => operations.remove(draft, some),
    () => operations.move(draft, some, random() * 4 - 2, random()),
    () =>
      edge
        ? operations.split(
            draft,
            [edge, draft.twinOf(edge)].filter((one) => one !== undefined),
          )
        : "",
    () => (edge && nodes.length ? join(draft, pick(nodes), edge) : ""),
    () => operations.merge(draft, [...new Set([pick(nodes), pick(nodes)].filter(Boolean))]),
    () => operations.reverse(draft, some),
    () => operations.makeOneWay(draft, some),
    () => operations.makeTwoWay(draft, some),
    () => operations.straighten(draft, some),
    () => operations.align(draft, some),
    () => operations.distribute(draft, some),
    () => operations.setProperty(draft, some, "speed_limit", random()),
    () => operations.paste(draft, some, 1, 1, "ground"),
    () => (edge ? operations.setLength(draft, edge, 1 + random() * 5) : ""),
    () => (nodes.length ? draw(draft, pick(nodes)) : ""),
  ];
  const outcome = pick(possible)();
  if (typeof outcome === "object") draft.execute(outcome);
}

/** What both changed in different fields is joined; of what both changed alike each keeps its own. */
function checkFields(): void {
  const properties = { kind: "node", name: "a", speed_limit: 1 };
  const base: Feature = {
    ...WHERE,
    id: "a",
    layer: "topology",
    geometry: { type: "Point", coordinates: [0, 0] },
    properties,
  };
  const key = keyOf(base);
  const moved = { ...base, geometry: { type: "Point" as const, coordinates: [1, 0] } };
  const named = { ...base, properties: { kind: "node", name: "b", speed_limit: 2 } };
  const met = (mine: Feature | null, theirs: Feature | null) =>
    compare([{ key, before: base, after: mine }], new Map(theirs ? [[key, theirs]] : []));
  const joined = met(moved, named);
  require(!joined.conflicts.length &&
    same(joined.clean[0]?.after, {
      ...moved,
      properties: named.properties,
    }), "different fields are joined");
  const { speed_limit: _, ...without } = properties;
  const both = { ...moved, properties: { ...without, name: "c" } };
  const [clash] = met(both, named).conflicts;
  require(same(clash?.fields, ["name", "speed_limit"]), "a property that one removed is a conflict");
  require(same(clash?.mine, both), "mine keeps its own");
  require(same(clash?.theirs, { ...named, geometry: moved.geometry }), "theirs has what only I have changed");
  require(!met(named, { ...moved, properties: named.properties }).conflicts
    .length, "the same on both sides is no conflict");
  require(same(met(null, named).conflicts[0]?.fields, []), "deleting what they changed is a conflict");
}

/** A network that was moved as a whole is merged in a time that grows with its size, not with its square. */
function checkLargeMerge(): void {
  const size = 70;
  const start = new Draft([]);
  const drawing = new Transaction(start);
  const nodes = Array.from({ length: size * size }, (_, index) =>
    drawing.put({
      ...WHERE,
      id: `n${index}`,
      layer: "topology",
      geometry: { type: "Point", coordinates: [index % size, Math.floor(index / size)] },
      properties: { kind: "node" },
    }),
  );
  nodes.forEach((node, index) => {
    const next = [index % size < size - 1 ? nodes[index + 1] : undefined, nodes[index + size]];
    for (const other of next) {
      if (!other) continue;
      drawing.addEdge(node, other);
      drawing.addEdge(other, node);
    }
  });
  start.execute(drawing.command("start"));
  const base = start.features();
  const draft = new Draft(base);
  const outcome = operations.move(draft, base.filter(isNode), 0.5, 0);
  if (typeof outcome === "object") draft.execute(outcome);
  const theirs = base.map((one) =>
    one.id === "n0" ? { ...one, properties: { ...one.properties, name: "Gate" } } : one,
  );
  const merge = compare(draft.changes(), new Map(theirs.map((one) => [keyOf(one), one])));
  const { command } = merged(theirs, merge, new Map(), (key) => draft.before(key), "merge");
  require(command?.edits.length === base.length, "all is moved");
}

checkFields();
checkLargeMerge();

for (let run = 0; run < RUNS; run++) {
  seed = run + 7;
  const base = network();
  const draft = new Draft(base);
  for (let index = 0; index < 25; index++) {
    if (random() < 0.15) draft.undo();
    else if (random() < 0.1) draft.redo();
    else step(draft);
    checkTied(draft, `run ${run}, step ${index}`);
  }
  const byKey = new Map(base.map((feature) => [keyOf(feature), feature]));
  for (const { key, after } of draft.changes()) {
    if (after) byKey.set(key, after);
    else byKey.delete(key);
  }
  const isWhole = draft.features().every((feature) => same(feature, byKey.get(keyOf(feature))));
  require(isWhole && byKey.size === draft.features().length, `run ${run}: the changes are not the difference`);
  const again = new Draft(base, structuredClone(draft.log), draft.position);
  require(draft
    .features()
    .every((feature) => same(feature, again.get(keyOf(feature)))), `run ${run}: the log does not give the draft again`);
  const other = new Draft(base);
  for (let index = 0; index < 10; index++) step(other);
  const theirs = new Map(other.features().map((feature) => [keyOf(feature), feature]));
  const merge = compare(withFreshIds(draft.changes(), theirs), theirs);
  const choices = new Map(merge.conflicts.map(({ key }) => [key, pick(["mine", "theirs", "both"] as const)]));
  const { command } = merged(theirs.values(), merge, choices, (key) => draft.before(key), "merge");
  const both = new Draft(theirs.values());
  if (command) both.execute(command);
  checkTied(both, `run ${run}, merged`);
  while (draft.undo());
  require(!draft.isChanged && base.every((feature) => draft.get(keyOf(feature)) === feature), `run ${run}: undo`);
}
