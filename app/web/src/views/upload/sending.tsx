/** An upload under way, or one that waits for the server. */
import { WifiOff, X } from "lucide-preact";
import { Button } from "../../ui/button";
import { bytes } from "../../ui/text";
import type { Desk, Step } from "./desk";
import { totalSize } from "./files";

export function Sending({ desk, step }: { desk: Desk; step: Extract<Step, { name: "sending" }> }) {
  const total = totalSize(desk.files.value);
  const isSent = step.share >= 1;
  const text = isSent
    ? step.commit
      ? "Saving …"
      : "Reading the files …"
    : `Sending ${bytes(step.share * total)} of ${bytes(total)}`;
  return (
    <section class="sending" role="status" aria-label="Upload">
      <p>{text}</p>
      {isSent ? <progress aria-label={text} /> : <progress value={step.share} max={1} aria-label="Sent" />}
      {!(step.commit && isSent) && (
        <Button icon={X} onClick={() => desk.untry()}>
          Cancel
        </Button>
      )}
    </section>
  );
}

export function Waiting({ desk }: { desk: Desk }) {
  return (
    <section class="note" role="status">
      <p>
        <WifiOff size={16} aria-hidden="true" /> The server does not answer. Keep this page open: the commit is sent
        when it answers again, once.
      </p>
      <div class="actions">
        <Button onClick={() => void desk.commit()}>Send now</Button>
        <Button quiet onClick={() => desk.stopWaiting()}>
          Do not send
        </Button>
      </div>
    </section>
  );
}
