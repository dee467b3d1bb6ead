/** Over the map of another time: whose map this is, of when, and the way back. */
import { createPortal } from "preact/compat";
import { useEffect } from "preact/hooks";
import { go, param } from "../../address";
import { apiPath, requestJson } from "../../api/client";
import { useLoaded } from "../../api/loaded";
import { Button } from "../../ui/button";
import { closuresAt, readLog } from "./closures";
import type { FleetMap } from "./fleet-map";
import { clock, reportAt } from "./status";
import type { FleetStore } from "./store";
import type { RobotDetail } from "./types";

export function TimeNote({ store, fleetMap }: { store: FleetStore; fleetMap: FleetMap }) {
  const name = param("robot");
  const time = param("time");
  return name && time ? (
    <Note key={`${name}/${time}`} store={store} fleetMap={fleetMap} name={name} time={time} />
  ) : null;
}

interface NoteProps {
  store: FleetStore;
  fleetMap: FleetMap;
  name: string;
  time: string;
}

function Note({ store, fleetMap, name, time }: NoteProps) {
  const loaded = useLoaded(
    async (signal) => {
      const path = apiPath(["robots", name], { environment: store.site.name, limit: 200 });
      const [robot, log] = await Promise.all([requestJson<RobotDetail>(path, { signal }), readLog(store.site, signal)]);
      const report = reportAt(robot.history, time);
      return { report, closures: report && closuresAt(log, report.overlays, time) };
    },
    [store.site.name, name, time],
  );
  const { data, problem } = loaded;
  useEffect(() => {
    fleetMap.past.value = data?.closures ?? [];
    return () => {
      fleetMap.past.value = null;
    };
  }, [data]);
  const area = fleetMap.map.map.getTargetElement()?.parentElement;
  if (!area) return null;
  return createPortal(
    <div class="time-note" role="status">
      <span>
        Map as <b>{name}</b> held it at <b>{clock(time)}</b>
        {data?.report && `: v${data.report.version}, ${closuresText(data.closures)}`}
        {data && !data.report && ": it had reported no map by then"}
        {problem && `: ${problem.message}`}
        <small>Where robots were then is not kept.</small>
      </span>
      <Button onClick={() => go({ time: null, version: null })}>Back to now</Button>
    </div>,
    area,
  );
}

function closuresText(closures: readonly unknown[] | null): string {
  if (!closures) return "with closures that are no longer known";
  if (closures.length === 0) return "nothing closed";
  return `${closures.length} closed`;
}
