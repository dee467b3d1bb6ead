/** How the files are read: format, layer, level, grid, mode, and the options of the format. */
import { param } from "../../address";
import type { DryRun, Schemas } from "../../api/client";
import type { Site } from "../../site";
import type { Desk } from "./desk";
import { fieldsFor, type FormatOption } from "./files";

interface Props {
  desk: Desk;
  site: Site;
  formats: Schemas["FormatOut"][];
  /** The dry run of these files, which tells their formats. */
  dry: DryRun | null;
}

const LAYERS: [string, string][] = [
  ["", "As the file says"],
  ["objects", "Objects"],
  ["topology", "Network"],
  ["zones", "Zones"],
  ["location", "Fence"],
];

export function Options({ desk, site, formats, dry }: Props) {
  const { format, layer, level, grid, mode, more } = desk.options.value;
  const found = [...new Set((dry?.sources ?? []).flatMap((source) => source.format ?? []))];
  const chosen = format ? [format] : found;
  const fields = fieldsFor(chosen);
  const options = formats
    .filter(({ id }) => chosen.includes(id))
    .flatMap(({ options: all }) => all as unknown as FormatOption[])
    .filter(
      (option, index, all) => option.for === "read" && all.findIndex(({ name }) => name === option.name) === index,
    );
  const isBusy = desk.step.value.name === "sending";
  const detected = found.map((id) => formats.find((one) => one.id === id)?.title ?? id);
  return (
    <details class="upload-options" open={param("options") !== null || undefined}>
      <summary>
        Options{" "}
        <span class="muted">
          {format
            ? titleOf(formats, format)
            : detected.length
              ? `found: ${detected.join(", ")}`
              : "found out from the files"}
          {mode === "merge" && " · merge"}
          {level && ` · level ${level}`}
        </span>
      </summary>
      <fieldset class="stack" disabled={isBusy}>
        <label class="field">
          <span>Format</span>
          <select value={format} onChange={(event) => desk.set({ format: event.currentTarget.value, more: {} })}>
            <option value="">Found out from the files</option>
            {formats.map(({ id, title }) => (
              <option key={id} value={id}>
                {title}
              </option>
            ))}
          </select>
        </label>
        <fieldset class="how">
          <legend>What these files do</legend>
          {(
            [
              ["replace", "Replace the map of this kind"],
              ["merge", "Merge into it: features with the same id are replaced, others stay"],
            ] as const
          ).map(([value, text]) => (
            <label key={value} class="check">
              <input type="radio" name="mode" checked={mode === value} onChange={() => desk.set({ mode: value })} />
              {text}
            </label>
          ))}
        </fieldset>
        <label class="field">
          <span>Level</span>
          <input
            list="upload-levels"
            value={level}
            placeholder="ground, or as the files say"
            onChange={(event) => desk.set({ level: event.currentTarget.value })}
          />
          <datalist id="upload-levels">
            {site.levels.value.map((name) => (
              <option key={name} value={name} />
            ))}
          </datalist>
        </label>
        {fields.layer && (
          <label class="field">
            <span>Layer of lines and polygons in a drawing</span>
            <select value={layer} onChange={(event) => desk.set({ layer: event.currentTarget.value })}>
              {LAYERS.map(([value, text]) => (
                <option key={value} value={value}>
                  {text}
                </option>
              ))}
            </select>
          </label>
        )}
        {fields.grid && (
          <label class="field">
            <span>Name of the grid</span>
            <input
              value={grid}
              placeholder="the name of the file"
              onChange={(event) => desk.set({ grid: event.currentTarget.value })}
            />
          </label>
        )}
        {options.map((option) => (
          <OptionField
            key={option.name}
            option={option}
            value={more[option.name] ?? ""}
            onChange={(value) => desk.set({ more: { ...more, [option.name]: value } })}
          />
        ))}
      </fieldset>
    </details>
  );
}

function titleOf(formats: Props["formats"], id: string): string {
  return formats.find((one) => one.id === id)?.title ?? id;
}

interface FieldProps {
  option: FormatOption;
  value: string;
  onChange: (value: string) => void;
}

function OptionField({ option, value, onChange }: FieldProps) {
  const { name, schema, description } = option;
  const choices = schema.type === "boolean" ? ["true", "false"] : schema.enum;
  const isNumber = schema.type === "number" || schema.type === "integer";
  return (
    <label class="field">
      <span>{name.replaceAll("_", " ")}</span>
      {choices ? (
        <select value={value} onChange={(event) => onChange(event.currentTarget.value)}>
          <option value="">Default</option>
          {choices.map((one) => (
            <option key={one} value={one}>
              {schema.type === "boolean" ? (one === "true" ? "yes" : "no") : one}
            </option>
          ))}
        </select>
      ) : (
        <input
          type={isNumber ? "number" : "text"}
          step={schema.type === "integer" ? 1 : "any"}
          min={schema.minimum}
          max={schema.maximum}
          value={value}
          onChange={(event) => onChange(event.currentTarget.value)}
        />
      )}
      <small>{description}</small>
    </label>
  );
}
