/** When a channel moves: now, later, or as a roll-out. */
import { hoursAhead, type When } from "./when";

const CHOICES: [When["kind"], string, string][] = [
  ["now", "Now", "Robots take it as soon as they hear of it."],
  ["later", "Later", "The channel moves at a set time."],
  ["rollout", "Roll-out", "Robots fetch it first; the channel moves when enough are ready, and back if too many fail."],
];

export function WhenFields({ when, onChange }: { when: When; onChange: (when: When) => void }) {
  const set = (changes: Partial<When>) => onChange({ ...when, ...changes });
  return (
    <fieldset class="history-part when">
      <legend>When</legend>
      {CHOICES.map(([kind, title, hint]) => (
        <label key={kind} class="check">
          <input
            type="radio"
            name="when"
            checked={when.kind === kind}
            onChange={() => set({ kind, at: when.at || hoursAhead(12) })}
          />
          <span>
            {title}
            <small>{hint}</small>
          </span>
        </label>
      ))}
      {when.kind === "later" && (
        <label class="field">
          <span>Time of the move</span>
          <input type="datetime-local" value={when.at} onInput={(event) => set({ at: event.currentTarget.value })} />
        </label>
      )}
      {when.kind === "rollout" && (
        <div class="rollout-fields">
          <Number title="Ready, % of online robots" value={when.ready} onInput={(ready) => set({ ready })} />
          <Number title="Stop if % of robots fail" value={when.failed} onInput={(failed) => set({ failed })} />
          <Number title="Watch for failures, minutes" value={when.window} onInput={(window) => set({ window })} />
          <label class="field">
            <span>Give up at (optional)</span>
            <input
              type="datetime-local"
              value={when.deadline}
              onInput={(event) => set({ deadline: event.currentTarget.value })}
            />
          </label>
        </div>
      )}
    </fieldset>
  );
}

function Number({ title, value, onInput }: { title: string; value: string; onInput: (value: string) => void }) {
  return (
    <label class="field">
      <span>{title}</span>
      <input type="number" min="1" step="1" value={value} onInput={(event) => onInput(event.currentTarget.value)} />
    </label>
  );
}
