/** Coverage: which format contains which information of this version, and how to get what is missing.
 *
 * In the address: `format` (open format), `losses=1` (what it would lose, drawn), `derive` (a derivation or generator,
 * or `any` for the choice), `find` (search), `have=1` (only what is available), `full=1` (the table over the map). */
import { Sparkles, Table } from "lucide-preact";
import { go, param } from "../../address";
import { api, ask } from "../../api/client";
import { type Loaded, useLoaded } from "../../api/loaded";
import { can } from "../../session";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { Empty, Show } from "../../ui/states";
import { count } from "../../ui/text";
import type { ViewProps } from "../registry";
import "./coverage.css";
import { loadDerivations } from "./derivations";
import { DeriveView } from "./derive";
import { FormatCard } from "./format-card";
import { FullTable } from "./full-table";
import { Mark } from "./mark";
import { StaleNote } from "./stale";
import {
  AVAILABILITY_TEXT,
  filterRows,
  INFORMATION,
  INFORMATION_TEXT,
  MAIN_INFORMATION,
  rowsOf,
  type State,
  type TableRow,
} from "./table";

export default function CoverageView({ site, map }: ViewProps) {
  const information = (site.version.value?.information ?? {}) as Record<string, string>;
  const rows = useRows(site);
  const derivations = useLoaded(loadDerivations, []);
  const method = param("derive");
  const format = param("format");
  const list = rows.data ?? [];
  const shown = filterRows(list, param("find") ?? "", param("have") === "1");
  const open = list.find(({ id }) => id === format);
  return (
    <>
      {param("full") === "1" && shown.length > 0 && (
        <FullTable map={map} rows={shown} title={`Formats of ${titleOf(site)}`} />
      )}
      {method && can("editor") ? (
        <Show of={derivations}>
          {(all) => <DeriveView site={site} map={map} derivations={all} method={method} information={information} />}
        </Show>
      ) : format && (open || rows.loading) ? (
        <Show of={rows}>
          {() =>
            open && <FormatCard key={open.id} site={site} map={map} row={open} derivations={derivations.data ?? []} />
          }
        </Show>
      ) : (
        <Overview site={site} rows={rows} shown={shown} information={information} />
      )}
    </>
  );
}

function useRows(site: Site): Loaded<TableRow[]> {
  const isReady = site.version.value !== null;
  const version = site.version.value;
  const loaded = useLoaded(
    async (signal) => {
      if (!isReady) return null;
      const params = { path: { env: site.name, v: site.exact } };
      const [formats, coverage] = await Promise.all([
        ask(api.GET("/api/v1/formats", { signal })),
        ask(api.GET("/api/v1/environments/{env}/versions/{v}/maps", { params, signal })),
      ]);
      return rowsOf(formats, coverage, (version?.information ?? {}) as Record<string, string>);
    },
    [site.name, isReady && site.exact],
  );
  return { ...loaded, data: loaded.data ?? undefined, loading: loaded.loading || (!isReady && !site.problem.value) };
}

interface OverviewProps {
  site: Site;
  rows: Loaded<TableRow[]>;
  shown: TableRow[];
  information: Record<string, string>;
}

function Overview({ site, rows, shown, information }: OverviewProps) {
  const isEmpty = site.version.value !== null && !INFORMATION.some((layer) => has(information, layer));
  return (
    <div class="stack">
      <Show of={rows}>
        {(all) => (
          <div class="stack">
            <section aria-label="Information in this version">
              <header class="card-head">
                <h2 class="grow">In this version</h2>
                {can("editor") && (
                  <Button icon={Sparkles} onClick={() => go({ derive: "any", format: null })}>
                    Derive
                  </Button>
                )}
              </header>
              <dl class="contents">
                {INFORMATION.map((layer) => (
                  <div key={layer}>
                    <dt>{INFORMATION_TEXT[layer]}</dt>
                    <dd>
                      <Mark state={(information[layer] ?? "missing") as State} />
                    </dd>
                  </div>
                ))}
              </dl>
            </section>
            <StaleNote site={site} />
            {isEmpty && (
              <Empty title="This version has no map yet">
                <p>Upload a file, or derive a made-up site: then most formats become available.</p>
                {can("editor") && <Button onClick={() => go({ view: "upload" })}>Upload files</Button>}
              </Empty>
            )}
            <FormatList all={all} shown={shown} />
          </div>
        )}
      </Show>
    </div>
  );
}

function FormatList({ all, shown }: { all: TableRow[]; shown: TableRow[] }) {
  const available = all.filter(({ state }) => state !== "missing").length;
  return (
    <section class="stack formats" aria-label="Formats">
      <header class="card-head">
        <h2 class="grow">
          Formats{" "}
          <small>
            {available} of {all.length} available
          </small>
        </h2>
        <Button
          icon={Table}
          class="wide-only"
          pressed={param("full") === "1"}
          onClick={() => go({ full: param("full") === "1" ? null : 1 }, { replace: true })}
        >
          Full table
        </Button>
      </header>
      <div class="find">
        <input
          type="search"
          aria-label="Search formats"
          placeholder="Search formats or files"
          value={param("find") ?? ""}
          onInput={(event) => go({ find: event.currentTarget.value }, { replace: true })}
        />
        <label class="check">
          <input
            type="checkbox"
            checked={param("have") === "1"}
            onChange={(event) => go({ have: event.currentTarget.checked ? 1 : null }, { replace: true })}
          />
          Only available
        </label>
      </div>
      <ul class="rows">
        {shown.map((row) => (
          <li key={row.id}>
            <FormatRow row={row} />
          </li>
        ))}
      </ul>
      {shown.length === 0 && (
        <Empty title="No format matches">
          <p>{count(all.length, "format")} in all.</p>
          <Button onClick={() => go({ find: null, have: null }, { replace: true })}>Show all</Button>
        </Empty>
      )}
    </section>
  );
}

function FormatRow({ row }: { row: TableRow }) {
  return (
    <button type="button" class={`row format-row ${row.state}`} onClick={() => go({ format: row.id })}>
      <span class="grow">
        <b>{row.title}</b>
        <small>
          {AVAILABILITY_TEXT[row.state]}
          {row.state !== "missing" && ` · ${row.format.files[0]}`}
        </small>
      </span>
      <span class="row-marks">
        {MAIN_INFORMATION.filter((layer) => row.cells[layer] !== "none").map((layer) => (
          <span key={layer} class="row-mark" title={`${INFORMATION_TEXT[layer]}: ${row.cells[layer]}`}>
            <small aria-hidden="true">{INFORMATION_TEXT[layer]?.slice(0, 3)}</small>
            <span class="visually-hidden">{INFORMATION_TEXT[layer]} </span>
            <Mark state={row.cells[layer]} bare />
          </span>
        ))}
      </span>
    </button>
  );
}

function has(information: Record<string, string>, layer: string): boolean {
  return (information[layer] ?? "missing") !== "missing";
}

function titleOf(site: Site): string {
  const version = site.number === null ? "the dry run" : `v${site.number}`;
  return `${site.environment.value?.title || site.name}, ${version}`;
}
