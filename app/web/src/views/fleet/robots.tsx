/** Robots as a list that mirrors the map: filter by standing, search by name. */

import { Plus } from "lucide-preact";
import { memo } from "preact/compat";
import { useEffect, useState } from "preact/hooks";
import { go, param } from "../../address";
import { Button } from "../../ui/button";
import { SearchField } from "../../ui/search-field";
import { Empty } from "../../ui/states";
import { count } from "../../ui/text";
import type { FleetMap } from "./fleet-map";
import { RobotCard } from "./robot-card";
import { backToNow, StandingMark } from "./standing-mark";
import { lagText, lasting, STANDING_NAMES, STANDINGS, type Standing, standingOf, stateText } from "./status";
import type { FleetStore } from "./store";

const SHOWN = 100;

interface RobotsProps {
  store: FleetStore;
  fleetMap: FleetMap;
  onAdd: () => void;
}

export function Robots({ store, fleetMap, onAdd }: RobotsProps) {
  const [text, setText] = useState("");
  store.round.value;
  const robots = store.all();
  const chosen = param("robot");
  const filter = param("state") as Standing | null;
  if (robots.length === 0) return <NoRobots onAdd={onAdd} />;
  const counts = new Map<Standing, number>();
  for (const robot of robots) counts.set(standingOf(robot), (counts.get(standingOf(robot)) ?? 0) + 1);
  const wanted = text.trim().toLowerCase();
  const names = robots
    .filter((robot) => (!filter || standingOf(robot) === filter) && robot.robot.toLowerCase().includes(wanted))
    .map(({ robot }) => robot);
  const channels = new Set(robots.map(({ channel }) => channel));
  return (
    <div class="stack">
      {chosen && <RobotCard key={chosen} store={store} fleetMap={fleetMap} name={chosen} />}
      <fieldset class="filters" aria-label="Show robots that are">
        <Filter name="all" total={robots.length} standing={null} chosen={filter} />
        {STANDINGS.filter((standing) => counts.has(standing) || standing === filter).map((standing) => (
          <Filter
            key={standing}
            name={STANDING_NAMES[standing]}
            total={counts.get(standing) ?? 0}
            standing={standing}
            chosen={filter}
          />
        ))}
      </fieldset>
      {(robots.length > 8 || text) && (
        <SearchField label="Search robots" hint="Search robots by name" value={text} onInput={setText} />
      )}
      {names.length === 0 && <p class="muted">No robot matches.</p>}
      <ul class="rows robot-rows" aria-label="Robots">
        {names.slice(0, SHOWN).map((name) => (
          <RobotRow key={name} store={store} name={name} isChosen={name === chosen} hasChannel={channels.size > 1} />
        ))}
      </ul>
      {names.length > SHOWN && (
        <p class="muted">{count(names.length - SHOWN, "more robot")}: search or filter to find them.</p>
      )}
      <div class="actions">
        <Button icon={Plus} onClick={onAdd}>
          Add a robot
        </Button>
      </div>
    </div>
  );
}

function NoRobots({ onAdd }: { onAdd: () => void }) {
  return (
    <Empty title="No robot has reported yet">
      <p>Run the agent on a robot: it fetches the maps of a channel and reports what it runs.</p>
      <Button main icon={Plus} onClick={onAdd}>
        Add a robot
      </Button>
    </Empty>
  );
}

interface FilterProps {
  name: string;
  total: number;
  standing: Standing | null;
  chosen: Standing | null;
}

function Filter({ name, total, standing, chosen }: FilterProps) {
  return (
    <button
      type="button"
      class="button filter"
      aria-pressed={standing === chosen}
      onClick={() => go({ state: standing }, { replace: true })}
    >
      {standing && <StandingMark standing={standing} />}
      {name} <b>{total}</b>
    </button>
  );
}

interface RowProps {
  store: FleetStore;
  name: string;
  isChosen: boolean;
  hasChannel: boolean;
}

const RobotRow = memo(function RobotRow({ store, name, isChosen, hasChannel }: RowProps) {
  const robot = store.robot(name)?.value;
  if (!robot) return null;
  const standing = standingOf(robot);
  return (
    <li>
      <button
        type="button"
        class="row"
        id={`robot-${name}`}
        aria-pressed={isChosen}
        onClick={() => go({ robot: isChosen ? null : name, closure: null, ...backToNow() })}
      >
        <StandingMark standing={standing} />
        <span class="grow">
          {name}
          <small>
            {stateText(robot)}
            {robot.detail && `: ${robot.detail}`}
            {hasChannel && ` · ${robot.channel}`}
          </small>
        </span>
        <RowLag store={store} name={name} />
      </button>
    </li>
  );
});

/** Ticks by itself, so that rows are not drawn each second. */
function RowLag({ store, name }: { store: FleetStore; name: string }) {
  const [, tick] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => tick((value) => value + 1), 15_000);
    return () => clearInterval(timer);
  }, []);
  const robot = store.robot(name)?.value;
  if (!robot) return null;
  const standing = standingOf(robot);
  const [what, since] = (
    robot.online ? lagText(robot, store.site.channels.value) : `silent since ${lasting(robot.received)}`
  ).split(" since ");
  return (
    <small class={`lag ${standing}`}>
      {what}
      {since && <span>since {since}</span>}
    </small>
  );
}
