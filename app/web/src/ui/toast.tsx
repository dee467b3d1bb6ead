/** Short messages about what has happened, which go by themselves. */
import { signal } from "@preact/signals";
import { X } from "lucide-preact";
import type { ComponentChildren } from "preact";
import { asApiError } from "../api/client";
import { Button } from "./button";
import { sentence } from "./states";

interface Toast {
  id: number;
  text: string;
  kind: "done" | "failed";
  action?: { label: string; run: () => void };
}

const toasts = signal<Toast[]>([]);
const SECONDS = 8;
let next = 0;

export function notify(text: string, { kind = "done", action }: Partial<Pick<Toast, "kind" | "action">> = {}): void {
  const toast: Toast = { id: ++next, text, kind, action };
  toasts.value = [...toasts.value.slice(-3), toast];
  if (kind === "done") setTimeout(() => close(toast.id), SECONDS * 1000);
}

/** Runs an action and shows why it failed. Returns undefined after a failure. */
export async function attempt<T>(run: () => Promise<T>): Promise<T | undefined> {
  try {
    return await run();
  } catch (error) {
    notify(sentence(asApiError(error).message), { kind: "failed" });
    return undefined;
  }
}

function close(id: number): void {
  toasts.value = toasts.value.filter((toast) => toast.id !== id);
}

export function Toasts(): ComponentChildren {
  return (
    <div class="toasts" role="status" aria-live="polite">
      {toasts.value.map(({ id, text, kind, action }) => (
        <div key={id} class={`toast ${kind}`}>
          <span>{text}</span>
          {action && (
            <Button
              quiet
              onClick={() => {
                action.run();
                close(id);
              }}
            >
              {action.label}
            </Button>
          )}
          <Button icon={X} label="Dismiss" quiet onClick={() => close(id)} />
        </div>
      ))}
    </div>
  );
}
