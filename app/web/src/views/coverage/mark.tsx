/** How a state is shown: by word, colour and shape. */
import { STATE_MEANING, STATE_TEXT, type State } from "./table";

export function Mark({ state, bare }: { state: State; bare?: boolean }) {
  return (
    <span class={`mark ${state}`} title={STATE_MEANING[state]}>
      {state !== "none" && <i aria-hidden="true" />}
      <span class={bare ? "visually-hidden" : undefined}>{STATE_TEXT[state]}</span>
    </span>
  );
}

export function MarkLegend() {
  return (
    <ul class="mark-legend" aria-label="What the marks mean">
      {(["raw", "derived", "generated", "template", "derivable", "missing"] as const).map((state) => (
        <li key={state}>
          <Mark state={state} />
          <small>{STATE_MEANING[state]}</small>
        </li>
      ))}
    </ul>
  );
}
