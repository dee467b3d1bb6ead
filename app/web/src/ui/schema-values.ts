/** Parameters as the server describes them, and what a form holds of them: text as typed. */

export interface Parameter {
  name: string;
  schema: {
    type?: "string" | "number" | "integer" | "boolean";
    enum?: (string | number)[];
    minimum?: number;
    maximum?: number;
    description?: string;
  };
  default: unknown;
  description: string;
}

/** Values by name; what is missing or empty is the default. */
export type Values = Record<string, string>;

export type Value = string | number | boolean;

/** Reads the parameters of an answer, which OpenAPI gives no type. */
export function asParameters(list: readonly unknown[]): Parameter[] {
  return list as Parameter[];
}

/** Splits "height of walls [m]" into its text and unit. */
export function textAndUnit(description: string): { text: string; unit: string } {
  const found = /^(.*?)\s*\[([^\]]+)\]$/s.exec(description);
  return found ? { text: found[1] ?? "", unit: found[2] ?? "" } : { text: description, unit: "" };
}

/** A default as people read it. */
export function defaultText(value: unknown): string {
  if (value === null || value === undefined || value === "") return "";
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (Array.isArray(value)) return value.join(",");
  return typeof value === "object" ? JSON.stringify(value) : String(value);
}

/** Says what is wrong with a value; empty: nothing. */
export function faultOf({ schema }: Parameter, text: string | undefined): string {
  if (text === undefined || text.trim() === "") return "";
  const isNumber = schema.type === "number" || schema.type === "integer";
  if (!isNumber) return "";
  const value = Number(text);
  if (!Number.isFinite(value)) return "must be a number";
  if (schema.type === "integer" && !Number.isInteger(value)) return "must be a whole number";
  if (schema.minimum !== undefined && value < schema.minimum) return `must be at least ${schema.minimum}`;
  if (schema.maximum !== undefined && value > schema.maximum) return `must be at most ${schema.maximum}`;
  return "";
}

export function isValid(parameters: readonly Parameter[], values: Values): boolean {
  return parameters.every((parameter) => !faultOf(parameter, values[parameter.name]));
}

/** Returns the values that were set, typed, without those that equal the default. */
export function setValues(parameters: readonly Parameter[], values: Values): Record<string, Value> {
  const out: Record<string, Value> = {};
  for (const { name, schema, default: usual } of parameters) {
    const text = values[name]?.trim();
    if (text === undefined || text === "") continue;
    const value =
      schema.type === "boolean"
        ? text === "true"
        : schema.type === "number" || schema.type === "integer"
          ? Number(text)
          : text;
    if (value !== usual && text !== defaultText(usual)) out[name] = value;
  }
  return out;
}

/** The inverse of `setValues`: values as a form holds them, without those that equal the default. */
export function textsOf(parameters: readonly Parameter[], given: Record<string, unknown>): Values {
  const out: Values = {};
  for (const { name, default: usual } of parameters) {
    const value = given[name];
    if (value === undefined || defaultText(value) === defaultText(usual)) continue;
    out[name] = typeof value === "boolean" ? String(value) : defaultText(value);
  }
  return out;
}
