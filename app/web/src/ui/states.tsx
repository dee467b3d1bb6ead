/** States that every view has: empty, loading, failed. */
import { RotateCw } from "lucide-preact";
import type { ComponentChildren } from "preact";
import type { ApiError } from "../api/client";
import type { Loaded } from "../api/loaded";
import { Button } from "./button";

/** Nothing there yet, and what to do next. */
export function Empty({ title, children }: { title: string; children?: ComponentChildren }) {
  return (
    <div class="empty">
      <p class="empty-title">{title}</p>
      {children}
    </div>
  );
}

/** A problem in the server's own words, with files and lines. */
export function Problem({ error, retry }: { error: ApiError; retry?: () => void }) {
  const { title, detail, errors } = error.problem;
  return (
    <div class="problem" role="alert">
      <p class="problem-title">{title}</p>
      <p>{sentence(detail)}</p>
      {errors && errors.length > 0 && !(errors.length === 1 && errors[0]?.problem === detail) && (
        <Findings items={errors} />
      )}
      {retry && (
        <Button icon={RotateCw} onClick={retry}>
          Try again
        </Button>
      )}
    </div>
  );
}

interface Finding {
  problem: string;
  file?: string | null;
  line?: number | null;
  where?: string | null;
}

export function Findings({ items }: { items: readonly Finding[] }) {
  return (
    <ul class="findings">
      {items.map((item, index) => (
        <li key={index}>
          {(item.file || item.where) && (
            <code>
              {item.file}
              {item.line ? `:${item.line}` : ""}
              {item.where ? ` ${item.where}` : ""}
            </code>
          )}{" "}
          <span>{item.problem}</span>
        </li>
      ))}
    </ul>
  );
}

/** Shows what was loaded, a problem above it, and bars while there is nothing yet. */
export function Show<T>({ of, children }: { of: Loaded<T>; children: (data: T) => ComponentChildren }) {
  return (
    <div class="show" aria-busy={of.loading}>
      {of.problem && <Problem error={of.problem} retry={of.reload} />}
      {of.data !== undefined ? children(of.data) : of.loading && <Bars />}
    </div>
  );
}

export function Bars() {
  return (
    <div class="bars" role="status" aria-label="Loading">
      <span />
      <span />
      <span />
    </div>
  );
}

export function sentence(text: string): string {
  return text ? text[0]?.toUpperCase() + text.slice(1) : text;
}
