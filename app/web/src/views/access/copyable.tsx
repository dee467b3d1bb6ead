/** A text to take along: shown whole, copied by a button. */
import { Check, Copy } from "lucide-preact";
import type { ComponentChildren } from "preact";
import { useId, useRef, useState } from "preact/hooks";
import { Button } from "../../ui/button";

interface Props {
  label: string;
  text: string;
  children?: ComponentChildren;
}

export function Copyable({ label, text, children }: Props) {
  const [isCopied, setCopied] = useState(false);
  const area = useRef<HTMLPreElement>(null);
  const id = useId();
  const copy = async () => {
    try {
      await navigator.clipboard.writeText(text);
      setCopied(true);
    } catch {
      // Without https browsers have no clipboard: the text is selected, to be copied by hand.
      if (area.current) getSelection()?.selectAllChildren(area.current);
    }
  };
  return (
    <div class="copyable">
      <span id={id}>{label}</span>
      <div>
        <pre ref={area} aria-labelledby={id} tabIndex={0} role="textbox" aria-readonly="true">
          {text}
        </pre>
        <Button icon={isCopied ? Check : Copy} label={`Copy ${label}`} onClick={() => void copy()} />
      </div>
      <small role="status">{isCopied ? "Copied." : children}</small>
    </div>
  );
}
