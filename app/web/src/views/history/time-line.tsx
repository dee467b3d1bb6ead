/** Time line: the versions, newest first, with what they changed and the channels that point to them. */
import { History, Rocket, TriangleAlert } from "lucide-preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { go, param } from "../../address";
import type { Channel, Version } from "../../api/client";
import { can } from "../../session";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { Empty, Findings, Show } from "../../ui/states";
import { count, Time } from "../../ui/text";
import type { Versions } from "./loads";
import { RestoreDialog } from "./restore-dialog";
import { changesInWords, marksOf } from "./words";

const SHOWN_CHANGES = 3;

export function TimeLine({ site, versions }: { site: Site; versions: Versions }) {
  const [restored, setRestored] = useState<number | null>(null);
  const head = site.environment.value?.version ?? 0;
  const shown = site.number;
  return (
    <section class="history-part" aria-label="Versions">
      <header class="history-head">
        <h2 class="grow">Versions</h2>
        {shown !== null && shown !== head && (
          <Button icon={History} onClick={() => go({ version: "latest" })}>
            Back to latest
          </Button>
        )}
      </header>
      {site.version.value?.version === null && <p class="note">The map shows a dry run: it is no version yet.</p>}
      <Show of={versions}>
        {(page) =>
          head === 0 ? (
            <Empty title="No version yet">
              <p>
                {can("editor")
                  ? "Open Upload and drop a map in: each upload and each edit becomes a version here."
                  : "An editor uploads the first map."}
              </p>
            </Empty>
          ) : (
            <ol class="time-line" aria-label="Versions, newest first">
              {page.versions.map((version) => (
                <VersionRow
                  key={version.version}
                  site={site}
                  version={version}
                  isShown={version.version === shown}
                  isHead={version.version === head}
                  others={page.versions}
                  onRestore={() => setRestored(version.version)}
                />
              ))}
            </ol>
          )
        }
      </Show>
      {versions.more && (
        <Button busy={versions.loadingMore} onClick={versions.more}>
          Show older versions
        </Button>
      )}
      <RestoreDialog site={site} version={restored} onClose={() => setRestored(null)} />
    </section>
  );
}

interface VersionRowProps {
  site: Site;
  version: Version;
  isShown: boolean;
  isHead: boolean;
  others: Version[];
  onRestore: () => void;
}

function VersionRow({ site, version, isShown, isHead, others, onRestore }: VersionRowProps) {
  const { version: number, message, author, time, parent } = version;
  const here = site.channels.value.filter((one) => one.version === number && one.channel !== "latest");
  const planned = site.channels.value.filter((one) => one.planned?.version === number);
  const changes = changesInWords(version.changes);
  const thinned = version.thinned;
  const row = useRef<HTMLLIElement>(null);
  useEffect(() => {
    if (isShown && param("version")) row.current?.firstElementChild?.scrollIntoView({ block: "nearest" });
  }, [isShown]);
  return (
    <li ref={row} class={isShown ? "version shown" : "version"}>
      <button
        type="button"
        class="version-main"
        aria-pressed={isShown}
        title={thinned ? `Its content was removed by the rule: ${thinned.rule}` : "Show on the map"}
        disabled={Boolean(thinned)}
        onClick={() => go({ version: number })}
      >
        <span class="version-title">
          <b>v{number}</b>
          {isHead && <Flag name="latest" />}
          {here.map((channel) => (
            <Flag key={channel.channel} name={channel.channel} channel={channel} />
          ))}
          {planned.map(({ channel }) => (
            <span key={channel} class="flag planned-flag">
              {channel}: planned
            </span>
          ))}
          {(version.tags ?? []).map((tag) => (
            <span key={tag} class="flag">
              {tag}
            </span>
          ))}
        </span>
        <span class="version-message">{message || (number === 0 ? "Created, still empty" : "No message")}</span>
        {changes.slice(0, isShown ? undefined : SHOWN_CHANGES).map((text) => (
          <small key={text}>{text}</small>
        ))}
        {!isShown && changes.length > SHOWN_CHANGES && <small>and {changes.length - SHOWN_CHANGES} more</small>}
        <small>
          {author} · <Time at={time} />
          {thinned && " · thinned"}
          {marksOf(
            version,
            others.find((one) => one.version === parent),
          ).map((mark) => (
            <span key={mark}>
              {" · "}
              <span class={`information ${mark}`}>{mark}</span>
            </span>
          ))}
          {version.warnings.length > 0 && (
            <span class="version-warnings">
              {" · "}
              <TriangleAlert size={12} aria-hidden="true" /> {count(version.warnings.length, "warning")}
            </span>
          )}
        </small>
      </button>
      {isShown && number > 0 && (
        <div class="version-more">
          <div class="actions">
            {can("editor") && (
              <Button main icon={Rocket} onClick={() => go({ promote: number })}>
                Promote…
              </Button>
            )}
            {parent !== null && !others.find((one) => one.version === parent)?.thinned && (
              <Button onClick={() => go({ from: parent, to: number })}>Compare with v{parent}</Button>
            )}
          </div>
          <div class="actions">
            {can("editor") && !isHead && <Button onClick={onRestore}>Restore…</Button>}
            <CompareWith number={number} others={others} />
          </div>
          {version.warnings.length > 0 && (
            <details>
              <summary>{count(version.warnings.length, "warning")}</summary>
              <Findings items={version.warnings} />
            </details>
          )}
        </div>
      )}
    </li>
  );
}

function Flag({ name, channel }: { name: string; channel?: Channel }) {
  const robots = channel?.robots;
  return (
    <span
      class={name === "latest" ? "flag" : "flag channel-flag"}
      title={robots ? count(robots.total, "robot") : undefined}
    >
      {name}
    </span>
  );
}

function CompareWith({ number, others }: { number: number; others: Version[] }) {
  return (
    <label class="compare-with">
      <span class="visually-hidden">Compare v{number} with another version</span>
      <select
        value=""
        onChange={(event) => {
          const other = Number(event.currentTarget.value);
          go({ from: Math.min(number, other), to: Math.max(number, other) });
        }}
      >
        <option value="" disabled>
          Compare with …
        </option>
        {others
          .filter(({ version, thinned }) => version !== number && !thinned)
          .map(({ version, message }) => (
            <option key={version} value={version}>
              v{version} {message.slice(0, 60)}
            </option>
          ))}
      </select>
    </label>
  );
}
