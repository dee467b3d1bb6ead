/** The report of a map: what it is made of, what was filled in, and what was dropped. */
import { apiPath } from "../../api/client";
import { requestWithJob } from "../../api/jobs";
import { useLoaded } from "../../api/loaded";
import type { Site } from "../../site";
import { Findings, Show } from "../../ui/states";
import { defaultText, type Value } from "../../ui/schema-values";
import { DroppedList } from "./losses";
import { Mark } from "./mark";
import { INFORMATION_TEXT, type State } from "./table";

interface Report {
  layers: { layer: string; level: string; name: string; information: string; steps: { step: string }[] }[];
  template: { what: string; value: unknown; why: string; option?: string | null; from: string }[];
  dropped: { what: string; count: number; why: string }[];
  warnings: { problem: string; file?: string; where?: string }[];
  closures: unknown[];
  attribution: string[];
}

export function ReportPart({ site, format, values }: { site: Site; format: string; values: Record<string, Value> }) {
  const path = apiPath(site.path("versions", site.exact, "reports", format), values);
  const report = useLoaded(async (signal) => (await (await requestWithJob(path, { signal })).json()) as Report, [path]);
  return <Show of={report}>{(data) => <ReportFound report={data} />}</Show>;
}

function ReportFound({ report }: { report: Report }) {
  return (
    <div class="stack">
      <section>
        <h4>Made of</h4>
        <ul class="plain-list">
          {report.layers.map((part) => (
            <li key={`${part.layer}/${part.level}/${part.name}`}>
              <Mark state={part.information as State} /> {INFORMATION_TEXT[part.layer] ?? part.layer}{" "}
              <small>
                {part.name}, {part.level}
                {part.steps.length > 0 && ` · ${part.steps.map(({ step }) => step).join(", ")}`}
              </small>
            </li>
          ))}
        </ul>
      </section>
      {report.template.length > 0 && (
        <section>
          <h4>Filled in, because no source states it</h4>
          <ul class="plain-list">
            {report.template.map((line) => (
              <li key={line.what}>
                {line.what}: <b>{defaultText(line.value)}</b>{" "}
                <small>
                  {line.why}
                  {line.option && `; set it with ${line.option.replaceAll("_", " ")}`}
                </small>
              </li>
            ))}
          </ul>
        </section>
      )}
      {report.dropped.length > 0 && (
        <section>
          <h4>Dropped</h4>
          <DroppedList dropped={report.dropped} />
        </section>
      )}
      {report.warnings.length > 0 && (
        <section>
          <h4>Warnings</h4>
          <Findings items={report.warnings} />
        </section>
      )}
      {report.attribution.length > 0 && (
        <section>
          <h4>Credits to show with it</h4>
          <ul class="plain-list">
            {report.attribution.map((text) => (
              <li key={text}>{text}</li>
            ))}
          </ul>
        </section>
      )}
    </div>
  );
}
