/** History: the time line of versions, comparison of any two, promotion and roll back.
 *
 * In the address: `version` the version shown; `from` and `to` the versions compared, `mode` how (overlay, swipe,
 * blink), `change` the chosen change; `promote` the version to promote, `channel` the channel; `robot`
 * and `time` for the map as a robot had it.
 */
import "./history.css";
import { useEffect } from "preact/hooks";
import { go, param } from "../../address";
import type { ViewProps } from "../registry";
import { can } from "../../session";
import { Channels } from "./channels";
import { Compare } from "./compare";
import { Drafts } from "./drafts";
import { useVersions } from "./loads";
import { Promote } from "./promote";
import { RobotTime } from "./robot-time";
import { TimeLine } from "./time-line";

export default function HistoryView({ site, map }: ViewProps) {
  const versions = useVersions(site);
  const from = param("from");
  const to = param("to");
  const promote = param("promote");
  const shown = param("version");
  const wanted = promote ?? (from && to ? to : null);
  useEffect(() => {
    if (wanted && wanted !== shown) go({ version: wanted }, { replace: true }); // the map shows what is spoken of
  }, [wanted, shown]);
  if (promote && can("editor")) return <Promote key={promote} site={site} map={map} version={promote} />;
  if (from && to) return <Compare site={site} map={map} from={from} to={to} versions={versions} />;
  return (
    <div class="stack">
      <Channels site={site} />
      <Drafts site={site} />
      <RobotTime site={site} />
      <TimeLine site={site} versions={versions} />
    </div>
  );
}
