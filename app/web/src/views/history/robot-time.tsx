/** Time machine: the map as a robot had it at a time. */
import { useEffect, useState } from "preact/hooks";
import { go, param } from "../../address";
import { apiPath, requestJson, type Robot, type Schemas } from "../../api/client";
import { useLoaded } from "../../api/loaded";
import type { Site } from "../../site";
import { Show } from "../../ui/states";
import { heldAt, localTime, type Report } from "./held";
import { exactTime } from "./when";

const REPORTS = 200;
const SHOWN = 8;

export function RobotTime({ site }: { site: Site }) {
  const [isOpen, setOpen] = useState(param("robot") !== null);
  const robots = useLoaded(
    async (signal) =>
      isOpen ? requestJson<Robot[]>(apiPath(["robots"], { environment: site.name, limit: 1000 }), { signal }) : null,
    [site.name, isOpen],
  );
  const robot = param("robot");
  return (
    <details class="robot-time" open={isOpen} onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>The map as a robot had it</summary>
      {isOpen && (
        <Show of={robots}>
          {(list) =>
            list && list.length > 0 ? (
              <div class="history-part">
                <label class="field inline">
                  <span>Robot</span>
                  <select value={robot ?? ""} onChange={(event) => go({ robot: event.currentTarget.value })}>
                    <option value="" disabled>
                      choose …
                    </option>
                    {list.map(({ robot: name }) => (
                      <option key={name}>{name}</option>
                    ))}
                  </select>
                </label>
                {robot && <Held key={robot} site={site} robot={robot} />}
              </div>
            ) : (
              list && <p class="muted">No robot has reported here yet.</p>
            )
          }
        </Show>
      )}
    </details>
  );
}

function Held({ site, robot }: { site: Site; robot: string }) {
  const detail = useLoaded(
    (signal) => {
      const path = apiPath(["robots", robot], { environment: site.name, limit: REPORTS });
      return requestJson<Schemas["RobotDetailOut"]>(path, { signal });
    },
    [site.name, robot],
  );
  const asked = Date.parse(param("time") ?? "");
  const [now] = useState(() => Date.now());
  const time = Number.isFinite(asked) ? asked : now;
  const history = (detail.data?.history ?? []) as unknown as Report[];
  const held = heldAt(history, time);
  useEffect(() => {
    if (held) go({ version: held.version }, { replace: true });
  }, [held?.version, time]);
  return (
    <>
      <label class="field inline">
        <span>Time</span>
        <input
          type="datetime-local"
          step={1}
          value={localTime(time)}
          onChange={(event) => {
            const value = Date.parse(event.currentTarget.value);
            if (Number.isFinite(value)) go({ time: new Date(value).toISOString() });
          }}
        />
      </label>
      <Show of={detail}>
        {() => (
          <div class="history-part">
            <p role="status">
              {held ? (
                <>
                  {robot} had <b>v{held.version}</b>, reported on {exactTime(held.received)}: the map shows it.
                </>
              ) : (
                <>{robot} had not reported a map by then.</>
              )}
            </p>
            <p class="muted">Where robots were is not kept: only their last place is known, see Fleet.</p>
            <Reports history={history} time={time} />
          </div>
        )}
      </Show>
    </>
  );
}

/** Its changes of map, to go to one directly. */
function Reports({ history, time }: { history: Report[]; time: number }) {
  const active = history.filter(({ state }) => state === "active");
  const held = heldAt(history, time);
  return (
    <ul class="rows" aria-label="Maps it had">
      {active.slice(0, SHOWN).map((report) => (
        <li key={report.received}>
          <button
            type="button"
            class="row"
            aria-pressed={report === held}
            onClick={() => go({ time: report.received })}
          >
            <b>v{report.version}</b>
            <span class="grow">from {exactTime(report.received)}</span>
          </button>
        </li>
      ))}
    </ul>
  );
}
