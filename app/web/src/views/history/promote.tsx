/** Promotion of a version to a channel, and roll back: first what it means for the robots, then when. */
import { ChevronLeft, Rocket, Undo2 } from "lucide-preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { go, param } from "../../address";
import { type ApiError, api, asApiError, ask, type Channel } from "../../api/client";
import { useLoaded } from "../../api/loaded";
import type { Site } from "../../site";
import { theme } from "../../theme";
import { Button } from "../../ui/button";
import { Problem, Show } from "../../ui/states";
import { count } from "../../ui/text";
import { attempt, notify } from "../../ui/toast";
import type { ViewProps } from "../registry";
import { ImpactList } from "./impact-list";
import { ImpactMap, impactFeatures } from "./impact-map";
import { loadFacts, type PromoteFacts } from "./loads";
import { WhenFields } from "./when-fields";
import { channelBody, exactTime, NOW, type When, whenProblem } from "./when";

const NAME = /^[a-z][a-z0-9_-]{0,62}$/;

export function Promote({ site, map, version }: ViewProps & { version: string }) {
  const channels = site.channels.value.filter(({ channel }) => channel !== "latest");
  const name = param("channel") ?? "production";
  const channel = channels.find((one) => one.channel === name);
  const from = channel?.version ?? null;
  const number = Number(version);
  const isBack = from !== null && number < from;
  const [when, setWhen] = useState<When>(NOW);
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<ApiError | null>(null);
  const facts = useLoaded((signal) => loadFacts(site, from, version, signal), [site.name, from, version]);
  useImpactMap({ site, map }, facts.data);
  // A roll back waits for nothing; nothing waits for an impact that cannot be had.
  const isUnread = !isBack && facts.data === undefined && facts.problem === null;
  const missing = NAME.test(name) ? whenProblem(when) : "Name the channel: small letters, digits, - and _.";
  const submit = async () => {
    setBusy(true);
    setProblem(null);
    try {
      const moved = await move(site, name, number, when);
      go({ promote: null, channel: null });
      report(site, moved, from);
    } catch (error) {
      setProblem(asApiError(error));
    } finally {
      setBusy(false);
    }
  };
  return (
    <form
      class="stack promote"
      aria-label={isBack ? "Roll back" : "Promote"}
      onSubmit={(event) => {
        event.preventDefault();
        if (!missing && !busy) void submit();
      }}
    >
      <header class="history-head">
        <Button quiet icon={ChevronLeft} label="Back" onClick={() => go({ promote: null, channel: null })} />
        <h2 class="grow">
          {isBack ? `Roll ${name} back to v${version}` : `Promote v${version}`}
          {from !== null && <small> {isBack ? `from v${from}` : `${name} has v${from}`}</small>}
        </h2>
      </header>
      {!isBack && <ChannelChoice channels={channels} name={name} />}
      {from === number ? (
        <p class="note">
          {name} has v{version} already.
        </p>
      ) : (
        <Show of={facts}>
          {(found) => <Facts site={site} map={map} facts={found} channel={name} from={from} version={version} />}
        </Show>
      )}
      {!isBack && <WhenFields when={when} onChange={setWhen} />}
      {problem && <Problem error={problem} />}
      {missing && <p class="muted">{missing}</p>}
      <div class="actions">
        <Button
          main
          type="submit"
          icon={isBack ? Undo2 : Rocket}
          busy={busy}
          disabled={Boolean(missing) || (from === number && !channel?.planned) || isUnread}
        >
          {isBack
            ? "Roll back now"
            : when.kind === "now"
              ? "Promote now"
              : when.kind === "later"
                ? "Plan the move"
                : "Start the roll-out"}
        </Button>
        <Button onClick={() => go({ promote: null, channel: null })}>Cancel</Button>
      </div>
    </form>
  );
}

async function move(site: Site, channel: string, version: number, when: When): Promise<Channel> {
  const params = { path: { env: site.name, channel } };
  const moved = await ask(
    api.PUT("/api/v1/environments/{env}/channels/{channel}", { params, body: channelBody(version, when) }),
  );
  await site.refresh();
  return moved;
}

function report(site: Site, moved: Channel, before: number | null): void {
  const planned = moved.planned as { version: number; activate_at: string | null } | null | undefined;
  if (planned) {
    const time = planned.activate_at ? `at ${exactTime(planned.activate_at)}` : "when enough robots are ready";
    notify(`${moved.channel} moves to v${planned.version} ${time}`);
    return;
  }
  const back = before !== null && before !== moved.version && before > 0 ? before : null;
  notify(
    `${moved.channel} is now v${moved.version}`,
    back === null
      ? {}
      : {
          action: {
            label: back < (moved.version ?? 0) ? `Roll back to v${back}` : `Return to v${back}`,
            run: () =>
              void attempt(async () => {
                const undone = await move(site, moved.channel, back, NOW);
                notify(`${undone.channel} is v${undone.version} again`);
              }),
          },
        },
  );
}

/** What the change takes from robots, drawn while the form is open. */
function useImpactMap({ site, map }: ViewProps, facts: PromoteFacts | undefined): void {
  const view = useRef<ImpactMap | null>(null);
  useEffect(() => {
    const made = new ImpactMap(map);
    view.current = made;
    return () => {
      made.close();
      view.current = null;
    };
  }, [map]);
  const features = site.features.value;
  const level = site.level.value;
  useEffect(() => {
    const drawn = facts?.impact ? impactFeatures(facts.impact, facts.changes, features) : [];
    view.current?.show(drawn, level);
  }, [facts, features, level]);
  useEffect(() => view.current?.repaint(), [theme.value]);
}

function ChannelChoice({ channels, name }: { channels: Channel[]; name: string }) {
  const names = new Set(["production", ...channels.map(({ channel }) => channel)]);
  const [isNew, setNew] = useState(!names.has(name));
  return (
    <div class="history-part">
      <label class="field inline">
        <span>Channel</span>
        <select
          value={isNew ? "+" : name}
          onChange={(event) => {
            const { value } = event.currentTarget;
            setNew(value === "+");
            go({ channel: value === "+" ? "new" : value }, { replace: true });
          }}
        >
          {[...names].map((one) => (
            <option key={one} value={one}>
              {one}
            </option>
          ))}
          <option value="+">Another channel …</option>
        </select>
      </label>
      {isNew && (
        <label class="field inline">
          <span>Its name</span>
          <input
            type="text"
            value={name}
            autocomplete="off"
            spellcheck={false}
            onInput={(event) => go({ channel: event.currentTarget.value.trim() || "new" }, { replace: true })}
          />
        </label>
      )}
    </div>
  );
}

interface FactsProps extends ViewProps {
  facts: PromoteFacts;
  channel: string;
  from: number | null;
  version: string;
}

function Facts({ site, map, facts, channel, from, version }: FactsProps) {
  return (
    <div class="stack">
      {facts.impact ? (
        <ImpactList site={site} map={map} impact={facts.impact} changes={facts.changes} channel={channel} />
      ) : (
        <p class="note">
          {channel} has no version yet: robots that follow it get v{version} as their first map.
        </p>
      )}
      <p class={facts.errors ? "note" : "muted"}>
        <span>
          {facts.errors || facts.warnings ? (
            <>
              Checks find{" "}
              {[facts.errors && count(facts.errors, "error"), facts.warnings && count(facts.warnings, "warning")]
                .filter(Boolean)
                .join(" and ")}{" "}
              in v{version}:{" "}
              <button
                type="button"
                class="link"
                onClick={() => go({ view: "checks", promote: null, channel: null, version })}
              >
                see them
              </button>
            </>
          ) : (
            <>Checks find no error in v{version}.</>
          )}
        </span>
      </p>
      {from !== null && (
        <div class="actions">
          <Button quiet onClick={() => go({ promote: null, channel: null, from, to: version })}>
            Compare v{from} with v{version}
          </Button>
        </div>
      )}
    </div>
  );
}
