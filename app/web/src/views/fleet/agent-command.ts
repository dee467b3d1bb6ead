/** The agent's command line. No DOM. */
export interface AgentChoices {
  server: string;
  environment: string;
  channel: string;
  robot: string;
  formats: string[];
  directory: string;
}

export function agentCommand({ server, environment, channel, robot, formats, directory }: AgentChoices): string {
  const parts = [
    `FLEETMAP_TOKEN=TOKEN fleetmap agent --server ${quote(server)}`,
    `--environment ${quote(environment)} --channel ${quote(channel)} --robot ${quote(robot || "ROBOT")}`,
    `--formats ${quote(formats.join(",") || "FORMATS")} --into ${quote(directory || "DIR")}`,
  ];
  return parts.join(" \\\n  ");
}

/** Quotes a word for a shell, if it needs to be. */
function quote(word: string): string {
  return /^[\w@%+=:,./-]+$/.test(word) ? word : `'${word.replaceAll("'", `'\\''`)}'`;
}
