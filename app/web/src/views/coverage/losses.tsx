/** What a format would lose of this version: on the map, and as a list. */
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { apiPath, type Schemas } from "../../api/client";
import { type Job, requestWithJob } from "../../api/jobs";
import { useLoaded } from "../../api/loaded";
import { useChangeLayer } from "../../map/change-layer";
import { type Changes, readChanges } from "../../map/changes";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { JobProgress } from "../../ui/job-progress";
import { Show } from "../../ui/states";
import { count } from "../../ui/text";
import { ChangeList } from "./change-list";
import type { TableRow } from "./table";

interface Dropped {
  what: string;
  count: number;
  why: string;
}

interface Report {
  read: boolean;
  dropped: Dropped[];
}

type Losses = Changes & Report;

export function LossesPart({ site, map, row }: { site: Site; map: SiteMap; row: TableRow }) {
  const [job, setJob] = useState<Job | null>(null);
  const [cancelled, setCancelled] = useState(false);
  const control = useRef<AbortController | null>(null);
  const losses = useLoaded(
    (signal) => {
      control.current = new AbortController();
      return loadLosses(site, row.id, AbortSignal.any([signal, control.current.signal]), setJob);
    },
    [site.name, site.exact, row.id],
  );
  useChangeLayer(map, losses.data?.changes);
  useEffect(() => () => void (map.selected.value = null), [map]);
  if (cancelled) return <p class="muted">Cancelled. Switch it off and on to start again.</p>;
  return (
    <>
      {job && (
        <JobProgress
          job={job}
          title="Writing the map and reading it back"
          onCancel={() => {
            control.current?.abort();
            setCancelled(true);
          }}
        />
      )}
      <Show of={losses}>{(data) => <LossesFound site={site} map={map} row={row} losses={data} />}</Show>
    </>
  );
}

function LossesFound({ site, map, row, losses }: { site: Site; map: SiteMap; row: TableRow; losses: Losses }) {
  const { changes, total, read, dropped } = losses;
  const [inside, outside] = useMemo(() => {
    const carried = changes.filter(({ layer }) => row.format.information[layer] === "raw");
    return [carried, changes.filter((one) => !carried.includes(one))];
  }, [changes, row]);
  if (!total && !dropped.length) {
    return (
      <p class="nothing-lost" role="status">
        Nothing is lost: the map, read back, equals this version.
      </p>
    );
  }
  return (
    <div class="stack">
      {!read && <p class="note">The server cannot read this format back: only what it drops is listed.</p>}
      {total > changes.length && (
        <p class="note">
          Too many to draw: the first {count(changes.length, "feature")} of {total} are shown.
        </p>
      )}
      {inside.length > 0 && (
        <section>
          <h4>Differs or is lost, though the format has room for it</h4>
          <ChangeList site={site} map={map} changes={inside} label="Differences" />
        </section>
      )}
      {outside.length > 0 && (
        <section>
          <h4>Has no place in this format</h4>
          <ChangeList site={site} map={map} changes={outside} label="Lost features" />
        </section>
      )}
      {dropped.length > 0 && (
        <section>
          <h4>Dropped, as the map’s report says</h4>
          <DroppedList dropped={dropped} />
        </section>
      )}
    </div>
  );
}

export function DroppedList({ dropped }: { dropped: readonly Dropped[] }) {
  return (
    <ul class="plain-list">
      {dropped.map((one) => (
        <li key={`${one.what} ${one.why}`}>
          {one.what}
          {one.count > 1 && ` × ${one.count}`} <small>{one.why}</small>
        </li>
      ))}
    </ul>
  );
}

async function loadLosses(
  site: Site,
  format: string,
  signal: AbortSignal,
  onJob: (job: Job | null) => void,
): Promise<Losses> {
  let report: Report = { read: true, dropped: [] };
  const changes = await readChanges(async (query) => {
    const path = apiPath(site.path("versions", site.exact, "losses"), { format, ...query });
    const answer: Schemas["LossesOut"] = await (await requestWithJob(path, { signal, onJob })).json();
    report = answer.report;
    return answer;
  });
  return { ...changes, ...report };
}
