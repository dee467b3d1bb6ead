/** The dialog of access tokens, for administrators. */
import { lazy, Suspense } from "preact/compat";
import { useState } from "preact/hooks";
import type { Schemas } from "../api/client";
import { Button } from "../ui/button";
import { Dialog } from "../ui/dialog";
import { Bars } from "../ui/states";

const Tokens = lazy(() => import("./access/tokens"));

export function Access({ open, onClose }: { open: boolean; onClose: () => void }) {
  const [created, setCreated] = useState<Schemas["NewTokenOut"] | null>(null);
  const [asks, setAsks] = useState(false);
  const show = (token: Schemas["NewTokenOut"] | null) => {
    setCreated(token);
    setAsks(false);
  };
  const close = () => {
    show(null);
    onClose();
  };
  return (
    <Dialog open={open} title="Tokens" onClose={() => (created ? setAsks(true) : close())} wide>
      {asks && created && (
        <div class="problem" role="alertdialog" aria-label="Close without the token?">
          <p>The token of “{created.name}” can never be shown again. Close without it?</p>
          <div class="actions">
            <Button main onClick={() => setAsks(false)}>
              Back to the token
            </Button>
            <Button danger onClick={close}>
              Close
            </Button>
          </div>
        </div>
      )}
      <Suspense fallback={<Bars />}>
        <Tokens created={created} onCreated={show} />
      </Suspense>
    </Dialog>
  );
}
