/** Closures: those that wait for a decision first, then those in force, then what has ended. */
import { Ban } from "lucide-preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { go, param } from "../../address";
import { can } from "../../session";
import { Button } from "../../ui/button";
import { Empty } from "../../ui/states";
import { count, Time } from "../../ui/text";
import { attempt, notify } from "../../ui/toast";
import { type Closure, closuresOf, type Decision, decide, geometryOf, moveEnd } from "./closures";
import { type End, EndFields } from "./end-fields";
import { endOf } from "./ends";
import type { FleetMap } from "./fleet-map";
import { NewClosureForm } from "./new-closure";
import { clock, convergence, remaining } from "./status";
import { type FleetStore, now } from "./store";

const SHOWN = 100;

interface ListProps {
  store: FleetStore;
  fleetMap: FleetMap;
}

export function Closures({ store, fleetMap }: ListProps) {
  const closures = closuresOf(store.overlays.value, fleetMap.byId.value);
  const pending = closures.filter(({ state }) => state === "pending");
  const accepted = closures.filter(({ state }) => state === "accepted");
  const ended = closures.filter(({ state }) => !["pending", "accepted"].includes(state)).reverse();
  const drawing = param("close");
  return (
    <div class="stack">
      {can("editor") &&
        (drawing ? <NewClosureForm store={store} fleetMap={fleetMap} kind={drawing} /> : <NewButtons />)}
      {closures.length === 0 && (
        <Empty title="Nothing is closed">
          <p>
            Reports of robots appear here at once. One tap closes the place for the whole fleet, until it ends by
            itself.
          </p>
        </Empty>
      )}
      <Group title="Waiting for a decision" closures={pending} store={store} fleetMap={fleetMap} />
      <Group title="Closed now" closures={accepted} store={store} fleetMap={fleetMap}>
        {accepted.length > 0 && <Taken store={store} />}
      </Group>
      {ended.length > 0 && (
        <details class="ended" open={ended.some(({ overlays }) => overlays.some(({ id }) => id === param("closure")))}>
          <summary>Ended in the last 30 days ({ended.length})</summary>
          <ul class="closures">
            {ended.slice(0, SHOWN).map((closure) => (
              <ClosureItem key={closure.id} closure={closure} store={store} fleetMap={fleetMap} />
            ))}
          </ul>
        </details>
      )}
    </div>
  );
}

function NewButtons() {
  return (
    <div class="actions">
      <Button icon={Ban} onClick={() => go({ close: "street", closure: null })}>
        Close a street
      </Button>
      <Button icon={Ban} onClick={() => go({ close: "area", closure: null })}>
        Close an area
      </Button>
    </div>
  );
}

interface GroupProps extends ListProps {
  title: string;
  closures: Closure[];
  children?: preact.ComponentChildren;
}

function Group({ title, closures, store, fleetMap, children }: GroupProps) {
  if (closures.length === 0) return null;
  return (
    <section aria-label={title}>
      <h2>
        {title} ({closures.length})
      </h2>
      {children}
      <ul class="closures">
        {closures.slice(0, SHOWN).map((closure) => (
          <ClosureItem key={closure.id} closure={closure} store={store} fleetMap={fleetMap} />
        ))}
      </ul>
      {closures.length > SHOWN && (
        <p class="muted">{count(closures.length - SHOWN, "more closure")}: decide on these first.</p>
      )}
    </section>
  );
}

/** How the robots took the closures in force. */
function Taken({ store }: { store: FleetStore }) {
  store.round.value;
  const robots = store.all();
  const rows = store.site.channels.value.flatMap((channel) => {
    const { total } = convergence(channel, robots);
    const have = robots.filter(
      (robot) => robot.channel === channel.channel && robot.holds?.overlays === channel.overlays?.digest,
    ).length;
    return total ? [`${channel.channel}: ${have} of ${count(total, "robot")} keep out`] : [];
  });
  return <p class="muted">{rows.length ? rows.join(" · ") : "No robot follows a channel here yet."}</p>;
}

interface ItemProps extends ListProps {
  closure: Closure;
}

function ClosureItem({ closure, store, fleetMap }: ItemProps) {
  const { first, state } = closure;
  const chosen = param("closure");
  const isChosen = closure.overlays.some(({ id }) => id === chosen);
  const element = useRef<HTMLLIElement>(null);
  useEffect(() => {
    if (isChosen) element.current?.scrollIntoView({ block: "nearest" });
  }, [isChosen]);
  return (
    <li ref={element} id={`closure-${closure.id}`} class={`closure ${state}${isChosen ? " chosen" : ""}`}>
      <button
        type="button"
        class="row"
        aria-pressed={isChosen}
        onClick={() => {
          go({ closure: isChosen ? null : closure.id, robot: null });
          if (!isChosen) reveal(closure, fleetMap);
        }}
      >
        <span class="grow">
          <b>{closure.title}</b>
          {first.detail && <span class="closure-detail">{first.detail}</span>}
          <small>
            {first.reporter} · <Time at={first.created} />
            {first.level !== "ground" && ` · ${first.level}`}
          </small>
        </span>
        <Ends closure={closure} />
      </button>
      {isChosen && <Facts closure={closure} />}
      {can("editor") && <Actions closure={closure} store={store} isChosen={isChosen} />}
    </li>
  );
}

function Ends({ closure }: { closure: Closure }) {
  const { first, state } = closure;
  if (state !== "pending" && state !== "accepted") return <small class="lag">{state}</small>;
  return (
    <small class="ends" title={`ends at ${clock(first.expires)}`}>
      ends in
      <b>{remaining(first.expires, now.value)}</b>
    </small>
  );
}

function Facts({ closure }: { closure: Closure }) {
  const { first, overlays } = closure;
  return (
    <dl class="closure-facts">
      {first.edge && (
        <>
          <dt>{closure.isTwoWay ? "edges" : "edge"}</dt>
          <dd>{overlays.map(({ edge }) => edge).join(", ")}</dd>
        </>
      )}
      <dt>level</dt>
      <dd>{first.level}</dd>
      <dt>reported</dt>
      <dd>
        {clock(first.created)} by {first.reporter}
      </dd>
      <dt>ends</dt>
      <dd>{clock(first.expires)}</dd>
      {first.decided_by && (
        <>
          <dt>decided</dt>
          <dd>
            {first.decided && clock(first.decided)} by {first.decided_by}
          </dd>
        </>
      )}
      {first.version && (
        <>
          <dt>permanent</dt>
          <dd>since v{first.version}</dd>
        </>
      )}
    </dl>
  );
}

const DONE: Record<Decision, string> = {
  accept: "Closed for all robots",
  reject: "Rejected",
  end: "Open again",
  keep: "Made permanent",
};

function Actions({ closure, store, isChosen }: { closure: Closure; store: FleetStore; isChosen: boolean }) {
  const [busy, setBusy] = useState<Decision | null>(null);
  const run = async (decision: Decision) => {
    setBusy(decision);
    const done = await attempt(() => decide(store, closure, decision));
    setBusy(null);
    if (!done) return store.load();
    keepFocus(closure);
    const version = decision === "keep" ? done.at(-1)?.version : null;
    if (decision === "accept") go({ closure: closure.id, robot: null }); // where its end can be changed
    const more = version ? ` in v${version}: promote it before the closure ends` : "";
    notify(`${DONE[decision]}: ${closure.title}${more}.`, {
      ...(version ? { action: { label: "History", run: () => go({ view: "history" }) } } : {}),
    });
  };
  const button = (decision: Decision, label: string, more: { main?: boolean; label?: string } = {}) => (
    <Button {...more} busy={busy === decision} disabled={busy !== null} onClick={() => void run(decision)}>
      {label}
    </Button>
  );
  if (closure.state === "pending") {
    return (
      <div class="actions">
        {button("accept", "Close for all robots", { main: true })}
        {button("reject", "Reject")}
      </div>
    );
  }
  if (closure.state !== "accepted" || !isChosen) return null;
  return (
    <>
      <NewEnd key={closure.first.expires} closure={closure} store={store} />
      <div class="actions">
        {button("end", "End now")}
        {!closure.first.version &&
          button("keep", "Make permanent", { label: "Creates a version in which it is blocked for good" })}
      </div>
    </>
  );
}

/** Another end for a closure in force. */
function NewEnd({ closure, store }: { closure: Closure; store: FleetStore }) {
  const [end, setEnd] = useState<End>({ choice: "60", until: "" });
  const [busy, setBusy] = useState(false);
  const submit = async (event: Event) => {
    event.preventDefault();
    setBusy(true);
    const expires = endOf(end.choice, end.until, new Date());
    const isDone = await attempt(() => moveEnd(store, closure, expires).then(() => true));
    setBusy(false);
    if (!isDone) return store.load();
    keepFocus(closure);
    notify(`${closure.title} is closed until ${clock(expires)}.`);
  };
  return (
    <form class="new-end" aria-label="Change the end" onSubmit={submit}>
      <EndFields end={end} onChange={setEnd} />
      <Button type="submit" busy={busy}>
        Change the end
      </Button>
    </form>
  );
}

/** The pressed button is gone with its state: the focus stays on the closure, or on the tab if that is folded away. */
function keepFocus(closure: Closure): void {
  requestAnimationFrame(() => {
    if (document.activeElement !== document.body) return;
    const row = document.querySelector<HTMLElement>(`#closure-${CSS.escape(closure.id)} button`);
    (row?.checkVisibility() ? row : document.getElementById("fleet-tab-closures"))?.focus();
  });
}

function reveal(closure: Closure, fleetMap: FleetMap): void {
  const geometry = geometryOf(closure.first, fleetMap.byId.peek(), fleetMap.map.site.frame.peek());
  if (!geometry) return;
  const level = closure.first.level;
  fleetMap.map.reveal({ id: closure.id, layer: "closures", level, part: "", geometry, properties: {} });
}
