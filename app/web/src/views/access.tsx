import { Dialog } from "../ui/dialog";

export function Access({ open, onClose }: { open: boolean; onClose: () => void }) {
  return (
    <Dialog open={open} title="Tokens" onClose={onClose} wide>
      <p />
    </Dialog>
  );
}
