/** The two versions that are compared: two handles on one line, and the same as lists. */
import { go } from "../../address";
import type { Version } from "../../api/client";
import { refName } from "./words";

interface Props {
  from: string;
  to: string;
  versions: Version[];
}

export function Tracks({ from, to, versions }: Props) {
  const numbers = versions.map(({ version }) => version).sort((one, other) => one - other);
  const messages = new Map(versions.map(({ version, message }) => [String(version), message]));
  const set = (name: "from" | "to", value: string) => go({ [name]: value, change: null }, { replace: true });
  return (
    <div class="tracks">
      {(["from", "to"] as const).map((name) => {
        const value = name === "from" ? from : to;
        const place = numbers.indexOf(Number(value));
        const title = name === "from" ? "From" : "To";
        return (
          <div class="track" key={name}>
            <label class="field inline">
              <span>{title}</span>
              <select value={value} onChange={(event) => set(name, event.currentTarget.value)}>
                {!numbers.includes(Number(value)) && <option value={value}>{refName(value)}</option>}
                {[...numbers].reverse().map((number) => (
                  <option key={number} value={String(number)}>
                    v{number} {messages.get(String(number))?.slice(0, 60)}
                  </option>
                ))}
              </select>
            </label>
            {place >= 0 && numbers.length > 1 && (
              <input
                type="range"
                aria-label={`${title}: place on the time line`}
                aria-valuetext={refName(value)}
                min={0}
                max={numbers.length - 1}
                value={place}
                onChange={(event) => set(name, String(numbers[Number(event.currentTarget.value)]))}
              />
            )}
          </div>
        );
      })}
    </div>
  );
}
