import { Empty } from "../../ui/states";
import type { ViewProps } from "../registry";

export default function View({ site }: ViewProps) {
  return <Empty title={`coverage of ${site.name}`} />;
}
