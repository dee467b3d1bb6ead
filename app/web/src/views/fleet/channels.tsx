/** Channels: what their robots run, how far they have converged, and who has gone silent. */
import { useId } from "preact/hooks";
import { go, link } from "../../address";
import { apiPath, type Channel, request } from "../../api/client";
import { can } from "../../session";
import { Button } from "../../ui/button";
import { attempt, notify } from "../../ui/toast";
import { type Convergence, clock, convergence, endedText, lasting, plannedText, some } from "./status";
import { type FleetStore, now } from "./store";

export function Channels({ store }: { store: FleetStore }) {
  store.round.value;
  const { channels } = store.site;
  const robots = store.all();
  const found = channels.value.map((channel) => ({ channel, found: convergence(channel, robots) }));
  // `latest` has no robots at most sites: it is shown if some follow it, or if there is no other.
  const shown = found.filter(
    ({ channel, found: { total } }) => channel.channel !== "latest" || total > 0 || found.length === 1,
  );
  return (
    <section class="channels" aria-label="Channels">
      {shown.map((item) => (
        <ChannelCard key={item.channel.channel} store={store} {...item} />
      ))}
    </section>
  );
}

function ChannelCard({ store, channel, found }: { store: FleetStore; channel: Channel; found: Convergence }) {
  const name = channel.channel;
  const planned = plannedText(channel, found);
  const ended = planned ? null : endedText(channel);
  const cancel = () =>
    attempt(async () => {
      await request(apiPath(store.site.path("channels", name, "planned")), { method: "DELETE" });
      notify(`The move of ${name} is cancelled.`);
      await store.site.refresh();
    });
  return (
    <article class="channel" aria-label={`Channel ${name}`}>
      <header>
        <h2>{name}</h2>
        <a
          class="chip"
          href={link({ view: "history" })}
          title="Promote or roll back in the history"
          onClick={(event) => {
            event.preventDefault();
            go({ view: "history" });
          }}
        >
          {channel.version === null ? "no version yet" : `v${channel.version}`}
        </a>
        <span class="spacer" />
        {found.total > 0 && (
          <small>
            {found.online} of {found.total} online
          </small>
        )}
      </header>
      {planned && (
        <p class="note" role="status">
          {planned}
          {channel.planned && found.total > 0 && (
            <progress
              max={found.total}
              value={found.ready}
              aria-label={`Robots of ${name} that have v${channel.planned.version}`}
            />
          )}
          {channel.planned && can("editor") && <Button onClick={() => void cancel()}>Cancel the move</Button>}
        </p>
      )}
      {ended && <p class="note">{ended}</p>}
      {found.total > 0 ? <Progress name={name} found={found} /> : <p class="muted">No robot follows this channel.</p>}
      {found.total > 0 && <Agreement channel={channel} found={found} />}
      {found.silent.length > 0 && <Silent found={found} />}
    </article>
  );
}

/** Robots that hold the map fill the bar from the left; failed ones fill it from the right, hatched. */
function Progress({ name, found }: { name: string; found: Convergence }) {
  const pattern = useId();
  const share = (robots: number) => `${(100 * robots) / found.total}%`;
  const words = [
    `${found.holding} of ${found.total} hold this map`,
    found.failed > 0 && `${found.failed} failed`,
    found.lagging > 0 && `${found.lagging} behind`,
  ].filter(Boolean);
  return (
    <>
      <div
        class="bar"
        role="progressbar"
        aria-label={`Robots of ${name} that hold its map`}
        aria-valuemin={0}
        aria-valuemax={found.total}
        aria-valuenow={found.holding}
        aria-valuetext={words.join(", ")}
      >
        <svg width="100%" height="100%" aria-hidden="true">
          <defs>
            <pattern id={pattern} width="6" height="6" patternUnits="userSpaceOnUse" patternTransform="rotate(45)">
              <rect width="6" height="6" class="failed-ground" />
              <rect width="2.5" height="6" class="failed-line" />
            </pattern>
          </defs>
          <rect class="holding" height="100%" width={share(found.holding)} />
          <rect
            height="100%"
            width={share(found.failed)}
            x={share(found.total - found.failed)}
            fill={`url(#${pattern})`}
          />
        </svg>
      </div>
      <p class="bar-text">{words.join(" · ")}</p>
    </>
  );
}

function Agreement({ channel, found }: { channel: Channel; found: Convergence }) {
  if (found.since && found.groups.length === 1) {
    const count = channel.overlays?.count ?? 0;
    return (
      <p class="agreement">
        All hold the same map since {clock(found.since)} ({lasting(found.since, now.value)})
        <small>
          root <Hash value={channel.root} /> · {count === 0 ? "no closures" : `${count} closed`}{" "}
          {count > 0 && <Hash value={channel.overlays?.digest ?? null} />}
        </small>
      </p>
    );
  }
  return (
    <table class="groups">
      <caption class="visually-hidden">Robots by the map that they hold</caption>
      <thead>
        <tr>
          <th scope="col">Robots</th>
          <th scope="col">Version</th>
          <th scope="col">Root</th>
          <th scope="col">Closures</th>
        </tr>
      </thead>
      <tbody>
        {found.groups.slice(0, 6).map((group) => (
          <tr key={group.key} class={group.isCurrent ? "current" : undefined} title={some(group.robots, 12)}>
            <td>{group.robots.length}</td>
            <td>{group.version === null ? "no map" : `v${group.version}`}</td>
            <td>
              <Hash value={group.root} />
            </td>
            <td>{group.root && <Hash value={group.closures} />}</td>
          </tr>
        ))}
      </tbody>
      {found.groups.length > 6 && <caption class="more">and {found.groups.length - 6} more maps</caption>}
    </table>
  );
}

function Hash({ value }: { value: string | null }) {
  if (!value) return <span class="muted">none</span>;
  return <code title={value}>{value.slice(0, 8)}</code>;
}

function Silent({ found }: { found: Convergence }) {
  const silent = [...found.silent].sort((a, b) => a.received.localeCompare(b.received));
  return (
    <p class="silent">
      <button type="button" class="link" onClick={() => go({ fleet: "robots", state: "silent", robot: null })}>
        Silent
      </button>
      : {some(silent.map(({ robot, received }) => `${robot} (${lasting(received, now.value)})`))}
    </p>
  );
}
