/** Compute a layer from others, or make up a site: choose, set parameters, try, save. */
import { ChevronLeft } from "lucide-preact";
import { useRef, useState } from "preact/hooks";
import { go, param } from "../../address";
import { type ApiError, apiPath, asApiError, type DryRun, isAbort, requestJson, type Version } from "../../api/client";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { SchemaForm } from "../../ui/schema-form";
import { isValid, setValues, textsOf, type Values } from "../../ui/schema-values";
import { Problem } from "../../ui/states";
import { type Derivation, lacking } from "./derivations";
import { DryRunResult } from "./dry-run";
import { problemsOf } from "./format-card";
import { INFORMATION, INFORMATION_TEXT } from "./table";

interface Props {
  site: Site;
  map: SiteMap;
  derivations: Derivation[];
  method: string;
  information: Record<string, string>;
}

export function DeriveView({ site, map, derivations, method, information }: Props) {
  const chosen = derivations.find(({ id }) => id === method);
  return (
    <article class="stack" aria-label="Derive a layer">
      <header class="card-head">
        <Button
          quiet
          icon={ChevronLeft}
          label={chosen ? "All derivations" : "Coverage"}
          onClick={() => go({ derive: chosen ? "any" : null, again: null })}
        />
        <div class="grow">
          <h2>{chosen ? givesText(chosen) : "Derive a layer"}</h2>
          {chosen && <small>{chosen.title}</small>}
        </div>
      </header>
      {chosen ? (
        <DeriveForm key={chosen.id} site={site} map={map} derivation={chosen} information={information} />
      ) : (
        <Choice derivations={derivations} information={information} />
      )}
    </article>
  );
}

function Choice({ derivations, information }: Pick<Props, "derivations" | "information">) {
  const computed = derivations.filter(({ isGenerator }) => !isGenerator);
  const layers = INFORMATION.filter((layer) => computed.some(({ gives }) => gives.includes(layer)));
  return (
    <>
      {layers.map((layer) => (
        <section key={layer}>
          <h3>
            {INFORMATION_TEXT[layer]} <small>now {information[layer] ?? "missing"}</small>
          </h3>
          <Choices list={computed.filter(({ gives }) => gives.includes(layer))} information={information} />
        </section>
      ))}
      <section>
        <h3>
          Made up <small>for tests and simulation</small>
        </h3>
        <Choices list={derivations.filter(({ isGenerator }) => isGenerator)} information={information} />
      </section>
    </>
  );
}

function Choices({ list, information }: { list: Derivation[]; information: Record<string, string> }) {
  const choices = list.map((one) => ({ one, needed: lacking(one, information) }));
  choices.sort((a, b) => Number(a.needed.length > 0) - Number(b.needed.length > 0)); // what works comes first
  return (
    <ul class="rows choices">
      {choices.map(({ one, needed }) => {
        return (
          <li key={one.id}>
            <button type="button" class="row" disabled={needed.length > 0} onClick={() => go({ derive: one.id })}>
              <span class="grow">
                {one.isGenerator ? one.id : `From ${one.needs.map(layerText).join(" + ")}`}
                <small>{one.title}</small>
                {needed.length > 0 && (
                  <small>Needs {needed.map(layerText).join(", ")}: upload or derive it first</small>
                )}
              </span>
            </button>
          </li>
        );
      })}
    </ul>
  );
}

interface FormProps {
  site: Site;
  map: SiteMap;
  derivation: Derivation;
  information: Record<string, string>;
}

function DeriveForm({ site, map, derivation, information }: FormProps) {
  const [used] = useState(() => usedParameters(site, derivation));
  const [values, setForm] = useState<Values>(used ?? {});
  const [seed, setSeed] = useState(0);
  const [replace, setReplace] = useState(false);
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<ApiError | null>(null);
  const [dry, setDry] = useState<DryRun | null>(null);
  const [unchanged, setUnchanged] = useState(false);
  const control = useRef<AbortController | null>(null);
  const { parameters, isGenerator } = derivation;
  const change = (next: Values) => {
    setForm(next);
    setDry(null); // it was made with other parameters
  };
  const attempt = async () => {
    control.current = new AbortController();
    setBusy(true);
    setProblem(null);
    setDry(null);
    setUnchanged(false);
    try {
      const answer = await requestJson<DryRun | Version>(
        apiPath(site.path(isGenerator ? "generations" : "derivations")),
        {
          method: "POST",
          headers: { "content-type": "application/json" },
          signal: control.current.signal,
          body: JSON.stringify({
            ...(isGenerator ? { generator: derivation.id, seed } : { method: derivation.id }),
            parameters: setValues(parameters, values),
            replace,
            dry_run: true,
          }),
        },
      );
      if (answer.version === null) setDry(answer as DryRun);
      else setUnchanged(true);
    } catch (error) {
      if (!isAbort(error)) setProblem(asApiError(error));
    } finally {
      setBusy(false);
    }
  };
  const own = derivation.gives.filter((layer) => ["raw", "generated"].includes(information[layer] ?? ""));
  const head = site.environment.value?.version;
  const isOld = site.number !== null && head !== undefined && site.number < head;
  return (
    <>
      {isOld && (
        <p class="note">
          You see v{site.number}. This runs on the latest version, v{head}.
        </p>
      )}
      {isGenerator && (
        <label class="field">
          <span>Seed: the same number gives the same site</span>
          <input
            type="number"
            min="0"
            step="1"
            value={seed}
            onInput={(event) => {
              setSeed(Math.max(0, Math.trunc(Number(event.currentTarget.value)) || 0));
              setDry(null);
            }}
          />
        </label>
      )}
      {used && <p class="muted">With the parameters of last time.</p>}
      {parameters.length > 0 && (
        <details
          class="part"
          open={parameters.length <= 4 || Object.keys(values).length > 0 || Boolean(problem?.problem.errors?.length)}
        >
          <summary>Parameters ({parameters.length}); all have defaults</summary>
          <SchemaForm parameters={parameters} values={values} onChange={change} problems={problemsOf(problem)} />
        </details>
      )}
      {(own.length > 0 || problem?.status === 409) && (
        <label class="check">
          <input
            type="checkbox"
            checked={replace}
            onChange={(event) => {
              setReplace(event.currentTarget.checked);
              setDry(null);
            }}
          />
          Replace what was uploaded, edited or generated
        </label>
      )}
      {problem && <Problem error={problem} retry={() => void attempt()} />}
      {unchanged && <p role="status">Nothing would change: the latest version has exactly this.</p>}
      <div class="actions">
        <Button main={!dry} busy={busy} disabled={!isValid(parameters, values)} onClick={() => void attempt()}>
          {dry ? "Try again" : "Try it on the map"}
        </Button>
        {busy && <Button onClick={() => control.current?.abort()}>Cancel</Button>}
      </div>
      {busy && <progress aria-label="Deriving" />}
      {dry && (
        <DryRunResult
          key={dry.id}
          site={site}
          map={map}
          dry={dry}
          onDrop={() => setDry(null)}
          onSaved={() => {
            setDry(null);
            go({ derive: null, again: null, version: "latest" }, { replace: true });
            void site.refresh();
          }}
        />
      )}
    </>
  );
}

/** The parameters that a part which is to be derived again had, as text; null: another derivation is made. */
function usedParameters(site: Site, { id, parameters }: Derivation): Values | null {
  const again = param("again");
  const part = site.version
    .peek()
    ?.stale.find(({ method, level, name }) => method === id && `${level}/${name}` === again);
  return part ? textsOf(parameters, part.parameters) : null;
}

function layerText(layer: string): string {
  return (INFORMATION_TEXT[layer] ?? layer).toLowerCase();
}

function givesText({ gives, needs, id, isGenerator }: Derivation): string {
  if (isGenerator) return `Made up: ${id}`;
  return `${gives.map((layer) => INFORMATION_TEXT[layer] ?? layer).join(", ")} from ${needs.map(layerText).join(" + ")}`;
}
