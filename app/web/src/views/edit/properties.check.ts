/** Values of properties as they are typed (run by tests/web/test_modules.py). */
import { require } from "../../in-node";
import { fromText, toText } from "./properties";
import { same } from "./draft";

for (const [name, text, value] of [
  ["name", "12", "12"],
  ["name", "true", "true"],
  ["name", "Gate 2", "Gate 2"],
  ["speed_limit", "0.8", 0.8],
  ["surface", "gravel", "gravel"],
  ["tags", '["a"]', ["a"]],
  ["code", '"12"', "12"],
] as const) {
  require(same(fromText(name, text), value), `${name} typed as ${text}`);
  require(toText(name, value) === text, `${name} shown as ${text}`);
}

// Names of uploaded maps may have spaces at their ends: what is shown is the name, not a text in quotes.
require(toText("name", " Gate 2 ") === " Gate 2 ", "a name is shown as it is");
