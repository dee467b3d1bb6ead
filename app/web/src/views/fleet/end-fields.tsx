/** When a closure ends: after some time, or at one. */
import { END_CHOICES, type EndChoice } from "./ends";

export interface End {
  choice: EndChoice;
  /** What the datetime-local field holds. */
  until: string;
}

export function EndFields({ end, onChange }: { end: End; onChange: (end: End) => void }) {
  return (
    <>
      <label class="field">
        <span>Until</span>
        <select
          value={end.choice}
          onChange={(event) => onChange({ ...end, choice: event.currentTarget.value as EndChoice })}
        >
          {END_CHOICES.map(([value, name]) => (
            <option key={value} value={value}>
              {name}
            </option>
          ))}
        </select>
      </label>
      {end.choice === "until" && (
        <label class="field">
          <span>End</span>
          <input
            type="datetime-local"
            required
            value={end.until}
            onInput={(event) => onChange({ ...end, until: event.currentTarget.value })}
          />
        </label>
      )}
    </>
  );
}
