/** The whole table over the map, for wide screens. */
import { X } from "lucide-preact";
import { createPortal } from "preact/compat";
import { useEffect } from "preact/hooks";
import { go, param } from "../../address";
import type { SiteMap } from "../../map/site-map";
import { Button } from "../../ui/button";
import { Mark, MarkLegend } from "./mark";
import { AVAILABILITY_TEXT, filesText, INFORMATION, INFORMATION_TEXT, type TableRow } from "./table";

export function FullTable({ map, rows, title }: { map: SiteMap; rows: TableRow[]; title: string }) {
  useEffect(() => {
    const press = (event: KeyboardEvent) => {
      if (event.key === "Escape" && !event.defaultPrevented) go({ full: null }, { replace: true });
    };
    addEventListener("keydown", press);
    return () => removeEventListener("keydown", press);
  }, []);
  const area = map.map.getTargetElement()?.parentElement;
  if (!area) return null;
  return createPortal(
    <section class="full-table" aria-label="Full table">
      <header class="card-head">
        <h2 class="grow">{title}</h2>
        <Button icon={X} label="Close the table" onClick={() => go({ full: null }, { replace: true })} />
      </header>
      <div class="table-scroll" tabIndex={0} role="group" aria-label="Formats and information">
        <table>
          <thead>
            <tr>
              <th scope="col">Format</th>
              {INFORMATION.map((layer) => (
                <th key={layer} scope="col">
                  {INFORMATION_TEXT[layer]}
                </th>
              ))}
              <th scope="col" class="download-column">
                Download
              </th>
            </tr>
          </thead>
          <tbody>
            {rows.map((row) => (
              <Line key={row.id} row={row} />
            ))}
          </tbody>
        </table>
        <MarkLegend />
      </div>
    </section>,
    area,
  );
}

function Line({ row }: { row: TableRow }) {
  const isOpen = param("format") === row.id;
  const show = () => go({ format: row.id, derive: null, losses: null });
  return (
    <tr aria-current={isOpen || undefined} class={row.state} onClick={show}>
      <th scope="row">
        <button
          type="button"
          class="link"
          onClick={(event) => {
            event.stopPropagation();
            show();
          }}
        >
          {row.title}
        </button>
        <small>
          {row.id} · {AVAILABILITY_TEXT[row.state]}
        </small>
      </th>
      {INFORMATION.map((layer) => (
        <td key={layer}>
          <Mark state={row.cells[layer]} />
        </td>
      ))}
      <td class="download-column">
        <small>{row.state === "missing" ? "" : filesText(row.format)}</small>
      </td>
    </tr>
  );
}
