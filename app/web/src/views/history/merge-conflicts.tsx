/** What a draft and the newest version changed differently, and which of the two wins. */
import { useEffect, useRef, useState } from "preact/hooks";
import { type ApiError, asApiError, online, type Schemas } from "../../api/client";
import { expired } from "../../session";
import { Button } from "../../ui/button";
import { sentence } from "../../ui/states";
import { count } from "../../ui/text";
import { LAYER_NAMES } from "./words";
import "./merge-conflicts.css";

export type Prefer = NonNullable<Schemas["RebaseBody"]["prefer"]>;

type Conflict = Schemas["ConflictOut"];

const SHOWN = 20;

interface Merge {
  conflicts: Conflict[];
  /** Rebases the draft. Throws ApiError unless it is refused for conflicts, which are then to be shown. */
  merge: (prefer?: Prefer) => Promise<void>;
}

export function useMerge(rebase: (prefer?: Prefer) => Promise<void>): Merge {
  const [conflicts, setConflicts] = useState<Conflict[]>([]);
  const merge = async (prefer?: Prefer) => {
    try {
      await rebase(prefer);
      setConflicts([]);
    } catch (error) {
      const found = conflictsOf(asApiError(error));
      if (!found.length) throw error;
      setConflicts(found);
    }
  };
  return { conflicts, merge };
}

/** The conflicts that a refused rebase names; none for any other error. */
function conflictsOf({ status, problem }: ApiError): Conflict[] {
  return status === 409 ? ((problem as Partial<Schemas["RebaseConflictsOut"]>).conflicts ?? []) : [];
}

interface Props {
  conflicts: Conflict[];
  head: number | undefined;
  busy: boolean;
  onChoose: (prefer: Prefer) => Promise<void>;
}

export function MergeConflicts({ conflicts, head, busy, onChoose }: Props) {
  const [chosen, setChosen] = useState<Prefer | null>(null);
  const element = useRef<HTMLElement>(null);
  useEffect(() => element.current?.scrollIntoView({ block: "nearest" }), []);
  const choose = (prefer: Prefer) => {
    setChosen(prefer);
    void onChoose(prefer);
  };
  const isCut = !online.value || expired.value;
  const isStuck = chosen !== null && !busy;
  return (
    <section ref={element} class="merge-conflicts" role="alert" aria-label="Conflicts of the merge">
      <p>
        <b>The draft and v{head} changed the same differently.</b>{" "}
        {isStuck
          ? "A choice does not solve what is left: edit these places of the draft, then merge it again."
          : "All else is merged. Which one wins at these places?"}
      </p>
      <ul>
        {conflicts.slice(0, SHOWN).map((one) => (
          <li key={`${one.layer} ${one.level} ${one.part} ${one.id ?? ""} ${one.fields.join()}`}>
            {LAYER_NAMES[one.layer] ?? sentence(one.layer)} {one.id ?? one.part}: {one.fields.join(", ")}
            {isStuck && <small>{sentence(one.reason)}</small>}
          </li>
        ))}
      </ul>
      {conflicts.length > SHOWN && <p class="muted">And {count(conflicts.length - SHOWN, "more")}.</p>}
      {!isStuck && (
        <div class="actions">
          <Button busy={busy} disabled={isCut} onClick={() => choose("draft")}>
            Keep the draft’s
          </Button>
          <Button busy={busy} disabled={isCut} onClick={() => choose("head")}>
            Keep those of v{head}
          </Button>
        </div>
      )}
    </section>
  );
}
