/** One format: whether it can be had, how, with which parameters; download, losses, report. */
import { ChevronLeft } from "lucide-preact";
import { useMemo, useState } from "preact/hooks";
import { go, link, param } from "../../address";
import type { ApiError } from "../../api/client";
import type { SiteMap } from "../../map/site-map";
import { can } from "../../session";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { SchemaForm } from "../../ui/schema-form";
import { asParameters, isValid, type Parameter, setValues, type Value, type Values } from "../../ui/schema-values";
import { sentence } from "../../ui/states";
import { open } from "../sites";
import type { Derivation } from "./derivations";
import { DownloadPart } from "./download";
import { LossesPart } from "./losses";
import { Mark } from "./mark";
import { ReportPart } from "./report";
import { AVAILABILITY_TEXT, INFORMATION, INFORMATION_TEXT, type Step, type TableRow } from "./table";

interface Props {
  site: Site;
  map: SiteMap;
  row: TableRow;
  derivations: Derivation[];
}

export function FormatCard({ site, map, row, derivations }: Props) {
  const [values, setForm] = useState<Values>({});
  const [problem, setProblem] = useState<ApiError | null>(null);
  const parameters = useMemo(() => parametersOf(row, derivations), [row, derivations]);
  const chosen = setValues(parameters, values);
  const showsLosses = param("losses") === "1";
  const isMissing = row.state === "missing";
  return (
    <article class="stack" aria-label={row.title}>
      <header class="card-head">
        <Button quiet icon={ChevronLeft} label="All formats" onClick={() => go({ format: null, losses: null })} />
        <div class="grow">
          <h2>{row.title}</h2>
          <small>
            {row.id} · {AVAILABILITY_TEXT[row.state]}
          </small>
        </div>
      </header>
      {isMissing ? <MissingPart site={site} row={row} /> : <ChainPart row={row} derivations={derivations} />}
      <Contents row={row} />
      {!isMissing && (
        <>
          {row.choose && <p class="note">{sentence(row.choose)}</p>}
          {parameters.length > 0 && (
            <details class="part" open={Boolean(problem)}>
              <summary>Parameters{Object.keys(chosen).length > 0 && ` (${Object.keys(chosen).length} set)`}</summary>
              <SchemaForm parameters={parameters} values={values} onChange={setForm} problems={problemsOf(problem)} />
            </details>
          )}
          <DownloadPart
            site={site}
            row={row}
            values={chosen}
            disabled={!isValid(parameters, values)}
            onProblem={setProblem}
          />
          <section class="part">
            <label class="check">
              <input
                type="checkbox"
                checked={showsLosses}
                onChange={(event) => go({ losses: event.currentTarget.checked ? 1 : null }, { replace: true })}
              />
              <b>Show on the map what would be lost</b>
            </label>
            {showsLosses && <LossesPart key={`${site.exact} ${row.id}`} site={site} map={map} row={row} />}
          </section>
          <ReportDetails site={site} row={row} values={isValid(parameters, values) ? chosen : {}} />
        </>
      )}
    </article>
  );
}

function ReportDetails({ site, row, values }: { site: Site; row: TableRow; values: Record<string, Value> }) {
  const [isOpen, setOpen] = useState(false);
  return (
    <details class="part" onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>Report of this map</summary>
      {isOpen && <ReportPart site={site} format={row.id} values={values} />}
    </details>
  );
}

function Contents({ row }: { row: TableRow }) {
  return (
    <dl class="contents" aria-label="Information in this format">
      {INFORMATION.filter((layer) => row.cells[layer] !== "none").map((layer) => (
        <div key={layer}>
          <dt>{INFORMATION_TEXT[layer]}</dt>
          <dd>
            <Mark state={row.cells[layer]} />
          </dd>
        </div>
      ))}
    </dl>
  );
}

/** How the map comes about: as stored, or by steps. */
function ChainPart({ row, derivations }: { row: TableRow; derivations: Derivation[] }) {
  if (!row.steps.length) return <p>Written from what is stored: nothing has to be derived.</p>;
  return (
    <section>
      <h3>Derived while it is made</h3>
      <ol class="chain">
        {row.steps.map((step, index) => (
          <li key={step.step}>
            <StepText step={step} number={index + 1} derivations={derivations} />
          </li>
        ))}
      </ol>
      <small>Robots get the result at once. To see, edit or fix it, save it as a version.</small>
    </section>
  );
}

function StepText({ step, number, derivations }: { step: Step; number: number; derivations: Derivation[] }) {
  const title = derivations.find(({ id }) => id === step.step)?.title ?? step.step;
  const from = step.from.map((layer) => INFORMATION_TEXT[layer] ?? layer).join(" + ");
  return (
    <>
      <b>
        {number}. {from} → {INFORMATION_TEXT[step.to] ?? step.to}
      </b>
      <small>{title}</small>
      {can("editor") && (
        <a class="link" href={link({ derive: step.step, format: null })} onClick={open(() => openDerive(step.step))}>
          Save this step as a version
        </a>
      )}
    </>
  );
}

function openDerive(method: string): void {
  go({ derive: method, format: null, losses: null });
}

function MissingPart({ site, row }: { site: Site; row: TableRow }) {
  return (
    <section class="note" aria-label="What is missing">
      <h3>Supply this first</h3>
      <ul class="plain-list">
        {row.missing.map((text) => (
          <li key={text}>{sentence(text)}</li>
        ))}
      </ul>
      {can("editor") ? (
        <div class="actions">
          <a class="button main" href={link({ view: "upload" })} onClick={open(() => go({ view: "upload" }))}>
            Upload files
          </a>
          <Button onClick={() => go({ derive: "any", format: null, losses: null })}>Derive a layer</Button>
        </div>
      ) : (
        <p>An editor of {site.name} can upload it.</p>
      )}
    </section>
  );
}

/** Parameters of the format's maps, and of the steps that run before. */
function parametersOf(row: TableRow, derivations: Derivation[]): Parameter[] {
  const own = asParameters(row.format.options.filter((option) => option.for === "write"));
  const names = new Set(own.map(({ name }) => name));
  const ofSteps = row.steps.flatMap(({ step }) => derivations.find(({ id }) => id === step)?.parameters ?? []);
  return [...own, ...asParameters(ofSteps).filter(({ name }) => !names.has(name) && names.add(name))];
}

/** Problems of a refused request by parameter. */
export function problemsOf(error: ApiError | null): Record<string, string> {
  const out: Record<string, string> = {};
  for (const { where, problem } of error?.problem.errors ?? []) {
    const name = where?.split(".").at(-1);
    if (name) out[name] = problem;
  }
  return out;
}
