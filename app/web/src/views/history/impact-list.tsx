/** What robots lose by a change, as a list: each entry zooms the map to its place. */
import type { Schemas } from "../../api/client";
import type { SiteMap } from "../../map/site-map";
import { boxOfChanges, type Change } from "../../map/changes";
import type { Site } from "../../site";
import { count } from "../../ui/text";
import { robotPlace } from "./impact-map";

type Impact = Schemas["ImpactOut"];
type RobotImpact = Impact["robots"][number];

const SHOWN = 50;

interface Props {
  site: Site;
  map: SiteMap;
  impact: Impact;
  changes: Change[];
  channel: string;
}

export function ImpactList({ site, map, impact, changes, channel }: Props) {
  const known = site.features.value;
  const zoomTo = (where: readonly number[] | null | undefined) => {
    const [x = 0, y = 0] = where ?? [];
    if (where) map.fit([x - 6, y - 6, x + 6, y + 6]);
  };
  const zoomToId = (id: string) => {
    const now = known.find((feature) => feature.id === id && feature.layer === "topology");
    const was = changes.find((change) => change.id === id && change.layer === "topology");
    if (now) map.fitFeatures([now]);
    else if (was) map.fit(boxOfChanges([was]));
  };
  const { edges, nodes, docks, parts } = impact;
  const isNothing = ![edges.deleted, edges.blocked, edges.turned, nodes.deleted, nodes.moved, docks, parts].some(
    (one) => one.length,
  );
  return (
    <section class="impact" aria-label="Impact">
      <h3>What robots lose</h3>
      <Robots robots={impact.robots} channel={channel} onShow={(robot) => zoomTo(robotPlace(robot, known)?.point)} />
      {isNothing && <p>Nothing in the network is deleted, blocked or cut off.</p>}
      <Items
        title="docks cut off or gone"
        one="dock cut off or gone"
        items={docks.map(({ id, name, why }) => ({ key: id, text: `${name}: ${why}`, show: () => zoomToId(id) }))}
      />
      <Items
        title="parts of the network cut off"
        one="part of the network cut off"
        items={parts.map(({ sample, nodes: size, why, where }) => ({
          key: sample.join(),
          text: `${size === 1 ? sample[0] : `${count(size, "node")} around ${sample[0]}`}: ${why}`,
          show: () => zoomTo(where),
        }))}
      />
      <Items
        title="edges deleted"
        one="edge deleted"
        items={edges.deleted.map((id) => ({ key: id, text: id, show: () => zoomToId(id) }))}
      />
      <Items
        title="edges blocked"
        one="edge blocked"
        items={edges.blocked.map(({ id, where, grid, zone }) => ({
          key: id,
          text: `${id}${zone ? `: in zone ${zone}` : grid ? `: in cells of ${grid}` : ""}`,
          show: () => (where ? zoomTo(where) : zoomToId(id)),
        }))}
      />
      <Items
        title="edges turned, or one-way now"
        one="edge turned, or one-way now"
        items={edges.turned.map((id) => ({ key: id, text: id, show: () => zoomToId(id) }))}
      />
      <Items
        title="nodes deleted"
        one="node deleted"
        items={nodes.deleted.map((id) => ({ key: id, text: id, show: () => zoomToId(id) }))}
      />
      <Items
        title="nodes moved"
        one="node moved"
        items={nodes.moved.map(({ id, distance }) => ({
          key: id,
          text: `${id}: by ${distance.toFixed(2)} m`,
          show: () => zoomToId(id),
        }))}
      />
      {impact.truncated && <p class="note">A list is longer than 10 000 entries: the rest is left out.</p>}
    </section>
  );
}

interface Item {
  key: string;
  text: string;
  show: () => void;
}

function Items({ title, one, items }: { title: string; one: string; items: Item[] }) {
  if (items.length === 0) return null;
  return (
    <details open={items.length <= 4}>
      <summary>{count(items.length, one, title)}</summary>
      <ul class="rows">
        {items.slice(0, SHOWN).map(({ key, text, show }) => (
          <li key={key}>
            <button type="button" class="row" title="Show on the map" onClick={show}>
              <span class="grow">{text}</span>
            </button>
          </li>
        ))}
      </ul>
      {items.length > SHOWN && <p class="muted">and {items.length - SHOWN} more</p>}
    </details>
  );
}

/** Robots of the channel by name; those without a place are said, never taken as untouched. */
function Robots({
  robots,
  channel,
  onShow,
}: {
  robots: RobotImpact[];
  channel: string;
  onShow: (robot: RobotImpact) => void;
}) {
  const own = robots.filter((robot) => robot.channel === channel);
  const of = (state: RobotImpact["state"]) => own.filter((robot) => robot.state === state);
  const [touched, clear, unknown] = [of("touched"), of("clear"), of("unknown")];
  const others = robots.length - own.length;
  return (
    <div class="impact-robots" role="group" aria-label="Robots">
      {own.length === 0 && <p>No robot follows {channel}.</p>}
      {touched.length > 0 && (
        <p>
          <b>{count(touched.length, "robot")} touched</b>
        </p>
      )}
      <ul class="rows">
        {touched.map((robot) => (
          <li key={robot.robot}>
            <button type="button" class="row touched" onClick={() => onShow(robot)}>
              <span class="robot-sign" aria-hidden="true">
                ▲
              </span>
              <span class="grow">
                {robot.robot}
                {!robot.online && " (offline)"}
                <small>{robot.why.join("; ")}</small>
              </span>
            </button>
          </li>
        ))}
      </ul>
      {unknown.length > 0 && (
        <p class="note">
          {count(unknown.length, "robot has", "robots have")} not reported where{" "}
          {unknown.length === 1 ? "it is" : "they are"}: {names(unknown)}
        </p>
      )}
      {clear.length > 0 && (
        <p class="muted">
          {count(clear.length, "robot is", "robots are")} clear of it: {names(clear)}
        </p>
      )}
      {others > 0 && own.length > 0 && (
        <p class="muted">{count(others, "robot follows", "robots follow")} other channels.</p>
      )}
    </div>
  );
}

function names(robots: RobotImpact[]): string {
  const shown = robots.slice(0, 12).map(({ robot }) => robot);
  return shown.join(", ") + (robots.length > shown.length ? ` and ${robots.length - shown.length} more` : "");
}
