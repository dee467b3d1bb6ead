/** The keys, in a dialog. */
import { Dialog } from "../../ui/dialog";
import { ACTIONS } from "./actions";
import type { Desk } from "./desk";

const TOOLS: [string, string][] = [
  ["S", "Select and move"],
  ["A", "Draw lanes"],
  ["X", "Split lanes by clicks"],
  ["Z", "Draw a zone"],
  ["O", "Draw an object"],
  ["F", "Draw the fence"],
  ["C", "Set cells in an area"],
  ["B", "Paint cells"],
];

const OTHERS: [string, string][] = [
  ["Enter", "Finish what is drawn"],
  ["Escape", "Cancel, then back to selecting"],
  ["Backspace", "Take back the last point; else delete"],
  ["Shift+drag", "Select by a box"],
  ["Shift+click", "Add to the selection, or take out"],
  ["Alt+click", "Select what lies below"],
  ["Alt", "Hold to release snapping"],
  ["G", "Snap to the grid, on and off"],
  ["Shift+arrows", "Move the selection a little"],
  ["Arrows", "Move the map; the cross in its middle is the pointer"],
  ["Space", "Click at the cross"],
  ["Ctrl+S", "Review and save"],
  ["?", "This list"],
];

export function Keys({ desk }: { desk: Desk }) {
  return (
    <Dialog
      open={desk.help.value}
      title="Keys"
      wide
      onClose={() => {
        desk.help.value = false;
      }}
    >
      <div class="edit-keys">
        <KeyList title="Tools" rows={TOOLS} />
        <KeyList title="Selection" rows={ACTIONS.map(({ key, title }) => [key, title])} />
        <KeyList title="While working" rows={OTHERS} />
      </div>
    </Dialog>
  );
}

function KeyList({ title, rows }: { title: string; rows: [string, string][] }) {
  return (
    <section>
      <h3>{title}</h3>
      <dl>
        {rows.map(([key, text]) => (
          <div key={key + text}>
            <dt>
              <kbd>{key}</kbd>
            </dt>
            <dd>{text}</dd>
          </div>
        ))}
      </dl>
    </section>
  );
}
