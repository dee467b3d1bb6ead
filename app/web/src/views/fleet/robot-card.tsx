/** One robot: what it runs, where it is, what it reported before, and the map as it held it at a time. */
import { Crosshair, Trash2, X } from "lucide-preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { go, param } from "../../address";
import { apiPath, request, requestJson } from "../../api/client";
import { type Loaded, useLoaded } from "../../api/loaded";
import { can } from "../../session";
import { Button } from "../../ui/button";
import { Empty, Show } from "../../ui/states";
import { Time } from "../../ui/text";
import { attempt, notify } from "../../ui/toast";
import type { FleetMap } from "./fleet-map";
import { backToNow, StandingMark } from "./standing-mark";
import { clock, lagText, reportAt, standingOf, stateText } from "./status";
import { type FleetStore, now } from "./store";
import type { Report, Robot, RobotDetail } from "./types";

interface CardProps {
  store: FleetStore;
  fleetMap: FleetMap;
  name: string;
}

export function RobotCard({ store, fleetMap, name }: CardProps) {
  store.names.value;
  const robot = store.robot(name)?.value;
  const detail = useLoaded(
    (signal) =>
      requestJson<RobotDetail>(apiPath(["robots", name], { environment: store.site.name, limit: 200 }), { signal }),
    [store.site.name, name],
  );
  const since = robot?.since;
  useEffect(() => {
    if (since && detail.data && since !== detail.data.since) detail.reload();
  }, [since]);
  const element = useRef<HTMLElement>(null);
  useEffect(() => {
    element.current?.scrollIntoView({ block: "nearest" });
    if (robot && !param("time")) fleetMap.reveal(robot);
  }, [name, robot === undefined]);
  if (!robot) {
    if (!store.loaded.value) return null;
    return (
      <Empty title={`${name} has not reported here`}>
        <Button onClick={() => go({ robot: null, ...backToNow() })}>All robots</Button>
      </Empty>
    );
  }
  return (
    <article ref={element} class="feature-card robot-card" aria-label={`Robot ${name}`}>
      <header>
        <StandingMark standing={standingOf(robot)} />
        <span class="grow">
          <b>{name}</b>
          <small>
            {stateText(robot)} · {robot.online ? "online" : "offline"}
          </small>
        </span>
        {fleetMap.placeOf(robot) && (
          <Button quiet icon={Crosshair} label="Show on the map" onClick={() => fleetMap.reveal(robot)} />
        )}
        {!robot.online && can("editor") && <Forget store={store} robot={robot} />}
        <Button
          quiet
          icon={X}
          label="Close the robot"
          onClick={() => {
            go({ robot: null, ...backToNow() });
            document.getElementById(`robot-${name}`)?.focus();
          }}
        />
      </header>
      <Facts store={store} robot={robot} />
      <Show of={detail as Loaded<RobotDetail>}>
        {({ history }) => (
          <>
            <TimeMachine name={name} history={history} />
            <History name={name} history={history} />
          </>
        )}
      </Show>
    </article>
  );
}

function Facts({ store, robot }: { store: FleetStore; robot: Robot }) {
  const { holds, place } = robot;
  return (
    <dl>
      <dt>channel</dt>
      <dd>
        {robot.channel}: {lagText(robot, store.site.channels.value, now.value)}
      </dd>
      {robot.detail && (
        <>
          <dt>detail</dt>
          <dd>{robot.detail}</dd>
        </>
      )}
      <dt>map</dt>
      <dd>
        {holds ? (
          <>
            v{holds.version} since <Time at={holds.since} />, root{" "}
            <code title={holds.root}>{holds.root.slice(0, 8)}</code>
          </>
        ) : (
          "has no map"
        )}
      </dd>
      <dt>place</dt>
      <dd>
        {place ? (
          <>
            {place.pose
              ? `${place.pose.x.toFixed(2)}, ${place.pose.y.toFixed(2)}${place.pose.level ? ` (${place.pose.level})` : ""}`
              : (place.node ?? "on its route")}
            {place.pose && place.node && `, node ${place.node}`}
            {place.route && place.route.length > 0 && `, ${place.route.length} stops ahead`} · <Time at={place.time} />
          </>
        ) : (
          "unknown: it does not report one"
        )}
      </dd>
      <dt>reported</dt>
      <dd>
        <Time at={robot.received} />
        {!robot.vouched && " · not authenticated: does not count in roll-outs"}
      </dd>
    </dl>
  );
}

/** The time machine: the version, and the closures, that this robot held at a time. */
function TimeMachine({ name, history }: { name: string; history: readonly Report[] }) {
  const [text, setText] = useState(localTime(new Date().toISOString()));
  const [missing, setMissing] = useState(false);
  const time = param("time");
  useEffect(() => {
    if (time) setText(localTime(time));
  }, [time]);
  const submit = (event: Event) => {
    event.preventDefault();
    const at = new Date(text);
    if (Number.isNaN(at.getTime())) return;
    at.setSeconds(at.getSeconds() + (text.length <= 16 ? 59 : 0)); // a minute means all of it
    const isShown = showAt(name, at.toISOString(), history);
    setMissing(!isShown);
  };
  return (
    <form class="time-machine" onSubmit={submit}>
      <label class="field">
        <span>Map as it was at</span>
        <input
          type="datetime-local"
          value={text}
          max={localTime(new Date().toISOString())}
          required
          onInput={(event) => setText(event.currentTarget.value)}
        />
      </label>
      <Button type="submit">Show</Button>
      {missing && (
        <p class="note" role="alert">
          {name} had reported no map by then. Its first report here:{" "}
          {history.length ? clock(history.at(-1)?.received ?? "") : "none"}.
        </p>
      )}
    </form>
  );
}

export function showAt(name: string, time: string, history: readonly Report[]): boolean {
  const report = reportAt(history, time);
  if (!report) return false;
  go({ robot: name, time, version: report.version, fleet: "robots" });
  return true;
}

function History({ name, history }: { name: string; history: readonly Report[] }) {
  const [all, setAll] = useState(false);
  const shown = all ? history : history.slice(0, 8);
  return (
    <section aria-label="History">
      <h3>History</h3>
      <ul class="history">
        {shown.map((report) => (
          <li key={report.received + report.state + report.version}>
            <time dateTime={report.received} title={new Date(report.received).toLocaleString("en-GB")}>
              {clock(report.received)}
            </time>
            <span class="grow">
              {report.state} v{report.version}
              {report.detail && <small>{report.detail}</small>}
              {report.overlays && <small title={report.overlays}>closures {report.overlays.slice(0, 8)}</small>}
            </span>
            {report.state === "active" && (
              <button type="button" class="link" onClick={() => showAt(name, report.received, history)}>
                Map then
              </button>
            )}
          </li>
        ))}
      </ul>
      {history.length > shown.length && (
        <Button quiet onClick={() => setAll(true)}>
          All {history.length} reports
        </Button>
      )}
    </section>
  );
}

/** Takes a robot that is gone out of its channel's count; its next report adds it again. */
function Forget({ store, robot }: { store: FleetStore; robot: Robot }) {
  const forget = () =>
    attempt(async () => {
      await request(apiPath(["robots", robot.robot], { environment: store.site.name }), { method: "DELETE" });
      store.forget(robot.robot);
      go({ robot: null });
      notify(`${robot.robot} is removed. Its next report adds it again.`);
    });
  return <Button quiet icon={Trash2} label="Remove from the fleet" onClick={() => void forget()} />;
}

function localTime(time: string): string {
  const at = new Date(time);
  return new Date(at.getTime() - at.getTimezoneOffset() * 60_000).toISOString().slice(0, 16);
}
