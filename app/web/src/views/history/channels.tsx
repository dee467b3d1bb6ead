/** Channels: which version each has, roll back, and what is planned. */
import { CalendarClock, Rocket, Undo2, X } from "lucide-preact";
import { useEffect } from "preact/hooks";
import { go } from "../../address";
import { api, ask, type Channel, type Schemas } from "../../api/client";
import { can } from "../../session";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { count, Time } from "../../ui/text";
import { attempt, notify } from "../../ui/toast";
import { useEarlier } from "./loads";
import { exactTime, percent } from "./when";

const PAUSE = 1000;

export function Channels({ site }: { site: Site }) {
  const channels = site.channels.value.filter(({ channel }) => channel !== "latest");
  useRobotReports(site, channels.some(isWaiting));
  const head = site.environment.value?.version ?? 0;
  return (
    <section class="history-part" aria-label="Channels">
      <h2>Channels</h2>
      {channels.length === 0 && (
        <p class="muted">
          No version is promoted yet: robots that follow <b>production</b> have no map.
        </p>
      )}
      <ul class="channel-list">
        {channels.map((channel) => (
          <ChannelRow key={channel.channel} site={site} channel={channel} />
        ))}
      </ul>
      {can("editor") && head > 0 && !channels.some(({ channel }) => channel === "production") && (
        <div class="actions">
          <Button icon={Rocket} onClick={() => go({ promote: head, channel: "production" })}>
            Promote v{head} to production…
          </Button>
        </div>
      )}
    </section>
  );
}

/** Reports of robots move a roll-out on: its numbers are read again, at most once a second. */
function useRobotReports(site: Site, isNeeded: boolean): void {
  useEffect(() => {
    if (!isNeeded) return;
    let timer = 0;
    const stop = site.events.subscribe(({ type }) => {
      if (type !== "robot.status" || timer) return;
      timer = window.setTimeout(() => {
        timer = 0;
        void site.refresh();
      }, PAUSE);
    });
    return () => {
      clearTimeout(timer);
      stop();
    };
  }, [site, isNeeded]);
}

function isWaiting({ planned, rollout }: Channel): boolean {
  return Boolean(planned) || rollout?.state === "watching";
}

function ChannelRow({ site, channel }: { site: Site; channel: Channel }) {
  const earlier = useEarlier(site, channel);
  const { robots, version, channel: name } = channel;
  const isBack = typeof earlier === "number" && version !== null && earlier < version;
  return (
    <li class="channel-row" aria-label={`Channel ${name}`}>
      <div class="channel-head">
        <span class="grow">
          <b>{name}</b>{" "}
          {version !== null && (
            <button type="button" class="link" onClick={() => go({ version })}>
              v{version}
            </button>
          )}
          <small>
            {version === null ? "no version yet" : <Since channel={channel} />}
            {robots && robots.total > 0 && ` · ${robots.holding} of ${count(robots.total, "robot")} on it`}
            {robots && robots.failed > 0 && ` · ${robots.failed} failed`}
          </small>
        </span>
        {can("editor") && typeof earlier === "number" && earlier > 0 && (
          <Button icon={Undo2} onClick={() => go({ promote: earlier, channel: name })}>
            {isBack ? "Roll back to" : "Return to"} v{earlier}
          </Button>
        )}
      </div>
      {channel.planned && <Planned site={site} channel={channel} />}
      {channel.rollout?.state === "watching" && (
        <p class="note">
          Roll-out of v{channel.rollout.version}: watched for failures
          {channel.rollout.failed !== null && `, rolled back if ${percent(channel.rollout.failed)} fail`}.
        </p>
      )}
      {(channel.rollout?.state === "failed" || channel.rollout?.state === "rolled_back") && channel.rollout.detail && (
        <p class="note">
          Roll-out of v{channel.rollout.version}: {channel.rollout.detail}
        </p>
      )}
    </li>
  );
}

function Since({ channel }: { channel: Channel }) {
  return (
    <>
      <Time at={channel.time} /> by {channel.author}
    </>
  );
}

interface PlannedMove {
  version: number;
  activate_at: string | null;
  author: string;
}

function Planned({ site, channel }: { site: Site; channel: Channel }) {
  const planned = channel.planned as unknown as PlannedMove;
  const rollout = channel.rollout?.state === "waiting" ? channel.rollout : null;
  return (
    <div class="planned">
      <CalendarClock size={18} aria-hidden="true" />
      <span class="grow">
        {rollout ? "Roll-out of" : "Planned:"}{" "}
        <button type="button" class="link" onClick={() => go({ version: planned.version })}>
          v{planned.version}
        </button>{" "}
        {planned.activate_at && <>at {exactTime(planned.activate_at)}</>}
        <small>
          by {planned.author}
          {rollout && channel.robots && ` · ${readyText(rollout, channel.robots)}`}
          {rollout?.deadline && ` · cancelled if not by ${exactTime(rollout.deadline)}`}
        </small>
      </span>
      {can("editor") && (
        <Button
          icon={X}
          label={`Cancel the planned move of ${channel.channel}`}
          onClick={() => void cancel(site, channel)}
        >
          Cancel
        </Button>
      )}
    </div>
  );
}

function readyText(rollout: Schemas["RolloutOut"], robots: Schemas["ChannelRobotsOut"]): string {
  const ready = `${robots.ready} of ${count(robots.online, "online robot")} ready`;
  return rollout.ready === null ? ready : `${ready}, moves at ${percent(rollout.ready)}`;
}

async function cancel(site: Site, channel: Channel): Promise<void> {
  const params = { path: { env: site.name, channel: channel.channel } };
  const done = await attempt(async () => {
    await ask(api.DELETE("/api/v1/environments/{env}/channels/{channel}/planned", { params }));
    return true;
  });
  if (!done) return;
  notify(`Cancelled: ${channel.channel} stays at ${channel.version === null ? "no version" : `v${channel.version}`}`);
  await site.refresh();
}
