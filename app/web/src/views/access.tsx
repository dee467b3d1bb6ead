/** The dialog of access tokens, for administrators. */
import { lazy, Suspense } from "preact/compat";
import { Dialog } from "../ui/dialog";
import { Bars } from "../ui/states";

const Tokens = lazy(() => import("./access/tokens"));

export function Access({ open, onClose }: { open: boolean; onClose: () => void }) {
  return (
    <Dialog open={open} title="Tokens" onClose={onClose} wide>
      <Suspense fallback={<Bars />}>
        <Tokens />
      </Suspense>
    </Dialog>
  );
}
