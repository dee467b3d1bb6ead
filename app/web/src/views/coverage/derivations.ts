/** What can be computed or made up here: derivations and generators, seen as one. Pure, but for loading. */
import { api, ask } from "../../api/client";
import { asParameters, type Parameter } from "../../ui/schema-values";

export interface Derivation {
  id: string;
  title: string;
  gives: string[];
  /** Information that must be there. */
  needs: string[];
  /** Information of which one must be there. */
  changes: string[];
  parameters: Parameter[];
  isGenerator: boolean;
}

export async function loadDerivations(signal: AbortSignal): Promise<Derivation[]> {
  const [derivations, generators] = await Promise.all([
    ask(api.GET("/api/v1/derivations", { signal })),
    ask(api.GET("/api/v1/generators", { signal })),
  ]);
  return [
    ...derivations.map((one) => ({
      ...one,
      gives: [one.gives],
      changes: [],
      parameters: asParameters(one.parameters),
      isGenerator: false,
    })),
    ...generators.map((one) => ({ ...one, parameters: asParameters(one.parameters), isGenerator: true })),
  ];
}

/** Returns the layers that a derivation needs and this version lacks. */
export function lacking(derivation: Derivation, information: Record<string, string>): string[] {
  const has = (layer: string) => (information[layer] ?? "missing") !== "missing";
  const out = derivation.needs.filter((layer) => layer in information && !has(layer));
  if (derivation.changes.length && !derivation.changes.some(has)) out.push(derivation.changes.join(" or "));
  return out;
}
