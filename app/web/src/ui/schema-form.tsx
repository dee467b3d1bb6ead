/** Fields for parameters that the server describes by JSON schema: units, bounds, defaults, and what they mean. */
import { useId } from "preact/hooks";
import { defaultText, faultOf, type Parameter, textAndUnit, type Values } from "./schema-values";
import "./schema-form.css";

interface Props {
  parameters: readonly Parameter[];
  values: Values;
  onChange: (values: Values) => void;
  /** Problems by name of the parameter, in the server's words. */
  problems?: Record<string, string>;
}

export function SchemaForm({ parameters, values, onChange, problems = {} }: Props) {
  return (
    <div class="schema-form">
      {parameters.map((parameter) => (
        <SchemaField
          key={parameter.name}
          parameter={parameter}
          value={values[parameter.name]}
          problem={faultOf(parameter, values[parameter.name]) || problems[parameter.name]}
          onChange={(value) => onChange({ ...values, [parameter.name]: value })}
        />
      ))}
    </div>
  );
}

interface FieldProps {
  parameter: Parameter;
  value: string | undefined;
  problem?: string;
  onChange: (value: string) => void;
}

function SchemaField({ parameter, value, problem, onChange }: FieldProps) {
  const id = useId();
  const { name, description } = parameter;
  const { text, unit } = textAndUnit(description);
  const help = [text, rangeText(parameter)].filter(Boolean).join("; ");
  return (
    <div class={problem ? "schema-field faulty" : "schema-field"}>
      <label for={id}>
        {name.replaceAll("_", " ")}
        {unit && <small> [{unit}]</small>}
      </label>
      <Input id={id} parameter={parameter} value={value} faulty={Boolean(problem)} onChange={onChange} />
      <p id={`${id}-help`}>{help}</p>
      {problem && (
        <p id={`${id}-problem`} class="schema-problem" role="alert">
          {problem}
        </p>
      )}
    </div>
  );
}

interface InputProps {
  id: string;
  parameter: Parameter;
  value: string | undefined;
  faulty: boolean;
  onChange: (value: string) => void;
}

function Input({ id, parameter, value, faulty, onChange }: InputProps) {
  const { schema, default: usual } = parameter;
  const common = { id, "aria-describedby": faulty ? `${id}-help ${id}-problem` : `${id}-help`, "aria-invalid": faulty };
  const usualText = defaultText(usual);
  if (schema.type === "boolean" || schema.enum) {
    const choices = schema.enum?.map(String) ?? ["true", "false"];
    return (
      <select {...common} value={value ?? ""} onChange={(event) => onChange(event.currentTarget.value)}>
        <option value="">{usualText ? `${usualText} (default)` : "default"}</option>
        {choices
          .filter((choice) => (schema.enum ? choice !== usualText : choice !== String(usual)))
          .map((choice) => (
            <option key={choice} value={choice}>
              {schema.enum ? choice : choice === "true" ? "yes" : "no"}
            </option>
          ))}
      </select>
    );
  }
  const isNumber = schema.type === "number" || schema.type === "integer";
  return (
    <input
      {...common}
      type={isNumber ? "number" : "text"}
      inputMode={isNumber ? "decimal" : undefined}
      step={schema.type === "integer" ? 1 : "any"}
      min={isNumber ? schema.minimum : undefined}
      max={isNumber ? schema.maximum : undefined}
      placeholder={usualText || "default"}
      autoComplete="off"
      value={value ?? ""}
      onInput={(event) => onChange(event.currentTarget.value)}
    />
  );
}

function rangeText({ schema }: Parameter): string {
  const { minimum: low, maximum: high } = schema;
  const words = schema.type === "string" && schema.description ? [schema.description] : [];
  if (low !== undefined && high !== undefined) words.push(`${low} to ${high}`);
  else if (low !== undefined) words.push(`at least ${low}`);
  else if (high !== undefined) words.push(`at most ${high}`);
  return words.join(", ");
}
