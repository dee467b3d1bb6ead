/** Findings of one rule. */
import { Wrench } from "lucide-preact";
import { useEffect, useRef } from "preact/hooks";
import type { Finding } from "../../checks";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { count } from "../../ui/text";
import { keyOf, type RuleGroup } from "./fixes";

const SHOWN = 100;

interface Props {
  group: RuleGroup;
  site: Site;
  chosen: Finding | undefined;
  onChoose: (finding: Finding) => void;
  /** Absent: repairs cannot be made here. */
  onFix?: (findings: Finding[]) => void;
}

export function RuleSection({ group, site, chosen, onChoose, onFix }: Props) {
  const { title, severity, items } = group;
  const fixable = items.filter(({ fix }) => fix);
  return (
    <details class="rule" open>
      <summary>
        <i class={`sign ${severity}`} aria-hidden="true" />
        <span class="grow">{title}</span>
        <span class="chip">{items.length}</span>
      </summary>
      {onFix && fixable.length > 1 && (
        <Button icon={Wrench} onClick={() => onFix(fixable)}>
          Fix all {fixable.length} …
        </Button>
      )}
      <ul class="rows">
        {items.slice(0, SHOWN).map((finding) => (
          <Row
            key={keyOf(finding)}
            finding={finding}
            isChosen={finding === chosen}
            hasLevels={site.levels.value.length > 1}
            onChoose={onChoose}
            onFix={onFix}
          />
        ))}
      </ul>
      {items.length > SHOWN && (
        <p class="muted">… and {count(items.length - SHOWN, "more finding")}: search for them.</p>
      )}
    </details>
  );
}

interface RowProps extends Pick<Props, "onChoose" | "onFix"> {
  finding: Finding;
  isChosen: boolean;
  hasLevels: boolean;
}

function Row({ finding, isChosen, hasLevels, onChoose, onFix }: RowProps) {
  const row = useRef<HTMLLIElement>(null);
  useEffect(() => {
    if (isChosen) row.current?.scrollIntoView({ block: "nearest" });
  }, [isChosen]);
  return (
    <li ref={row}>
      <button type="button" class="row" aria-pressed={isChosen} onClick={() => onChoose(finding)}>
        <span class="grow">{finding.detail}</span>
        {hasLevels && <small>{finding.level}</small>}
      </button>
      {isChosen && (
        <div class="finding-detail">
          <dl>
            <dt>features</dt>
            <dd>{finding.ids.join(", ") || "none"}</dd>
            {finding.where && (
              <>
                <dt>x, y</dt>
                <dd>{finding.where.map((value) => value.toFixed(2)).join(", ")}</dd>
              </>
            )}
          </dl>
          {finding.fix && onFix && (
            <Button icon={Wrench} onClick={() => onFix([finding])}>
              {finding.fix.title} …
            </Button>
          )}
        </div>
      )}
    </li>
  );
}
