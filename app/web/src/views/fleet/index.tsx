/** Fleet: how far robots have converged, where they are, and what is closed.
 *
 * The address holds: `fleet` (robots or closures), `state` (filter of robots), `robot`, `time` (the map as that robot
 * held it then, with `version`), `closure` (the selected one), `close` (street or area: a new closure is drawn) and
 * `edge` (the street chosen for it).
 */
import "./fleet.css";
import { useEffect, useMemo, useState } from "preact/hooks";
import { go, param } from "../../address";
import { Bars, Problem } from "../../ui/states";
import type { ViewProps } from "../registry";
import { AddRobot } from "./add-robot";
import { Channels } from "./channels";
import { Closures } from "./closure-list";
import { closuresOf } from "./closures";
import { FleetMap } from "./fleet-map";
import { Robots } from "./robots";
import { FleetStore } from "./store";
import { TimeNote } from "./time-note";

export default function FleetView({ site, map }: ViewProps) {
  const [opened, setOpened] = useState<{ store: FleetStore; fleetMap: FleetMap } | null>(null);
  useEffect(() => {
    const store = new FleetStore(site);
    const fleetMap = new FleetMap(map, store);
    setOpened({ store, fleetMap });
    return () => {
      fleetMap.close();
      store.close();
    };
  }, [site, map]);
  return opened && <Fleet key={site.name} {...opened} />;
}

function Fleet({ store, fleetMap }: { store: FleetStore; fleetMap: FleetMap }) {
  const [adding, setAdding] = useState(false);
  const part = param("fleet") ?? (param("closure") || param("close") ? "closures" : "robots");
  const overlays = store.overlays.value;
  const byId = fleetMap.byId.value;
  const waiting = useMemo(
    () => closuresOf(overlays, byId).filter(({ state }) => state === "pending").length,
    [overlays, byId],
  );
  const closed = useMemo(
    () => closuresOf(overlays, byId).filter(({ state }) => state === "accepted").length,
    [overlays, byId],
  );
  if (!store.loaded.value) {
    return store.problem.value ? <Problem error={store.problem.value} retry={() => void store.load()} /> : <Bars />;
  }
  return (
    <div class="stack fleet">
      {store.problem.value && <Problem error={store.problem.value} retry={() => void store.load()} />}
      <TimeNote store={store} fleetMap={fleetMap} />
      <Channels store={store} />
      <div class="parts" role="tablist" aria-label="Fleet">
        <Tab id="robots" part={part} name="Robots" total={store.names.value.length} />
        <Tab id="closures" part={part} name="Closures" total={closed} waiting={waiting} />
      </div>
      <div role="tabpanel" id={`fleet-${part}`} aria-labelledby={`fleet-tab-${part}`}>
        {part === "closures" ? (
          <Closures store={store} fleetMap={fleetMap} />
        ) : (
          <Robots store={store} fleetMap={fleetMap} onAdd={() => setAdding(true)} />
        )}
      </div>
      <AddRobot site={store.site} open={adding} onClose={() => setAdding(false)} />
    </div>
  );
}

interface TabProps {
  id: string;
  part: string;
  name: string;
  total: number;
  waiting?: number;
}

function Tab({ id, part, name, total, waiting = 0 }: TabProps) {
  const isOpen = part === id;
  const other = id === "robots" ? "closures" : "robots";
  const choose = (next: string) => go({ fleet: next, close: null, edge: null });
  return (
    <button
      type="button"
      role="tab"
      id={`fleet-tab-${id}`}
      aria-selected={isOpen}
      aria-controls={`fleet-${id}`}
      tabIndex={isOpen ? 0 : -1}
      onClick={() => choose(id)}
      onKeyDown={(event) => {
        if (event.key !== "ArrowLeft" && event.key !== "ArrowRight") return;
        choose(other);
        document.getElementById(`fleet-tab-${other}`)?.focus();
      }}
    >
      {name} <b>{total}</b>
      {waiting > 0 && <span class="waiting">{waiting} waiting</span>}
    </button>
  );
}
