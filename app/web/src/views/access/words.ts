/** What tokens are for, in words, and the commands that use them. */
import type { Role, Schemas } from "../../api/client";
import type { Session } from "../../session";

export type Token = Schemas["TokenOut"];

export const ROLES: [Role, string][] = [
  ["viewer", "Viewer: reads"],
  ["robot", "Robot: reads, reports its status"],
  ["mirror", "Mirror: another server that follows this one"],
  ["editor", "Editor: changes maps, promotes"],
  ["admin", "Administrator: all, also tokens"],
];

/** Whether a token may be the one that the user is signed in with: the session does not tell its id. */
export function mayBeOwn(token: Token, session: Session | null | undefined): boolean {
  return (
    session?.name === token.name &&
    session.role === token.role &&
    session.environments === token.environments &&
    session.robot === token.robot
  );
}

export function isExpired(token: Token, now = Date.now()): boolean {
  return token.ended !== null || (token.expires !== null && Date.parse(token.expires) <= now);
}

interface AgentCommand {
  token: string;
  server: string;
  robot: string;
  environment: string;
  formats: string;
}

/** The command that keeps a robot's maps up to date. */
export function agentCommand({ token, server, robot, environment, formats }: AgentCommand): string {
  return [
    `FLEETMAP_TOKEN=${quoted(token)}`,
    `fleetmap agent --server ${quoted(server)}`,
    `--robot ${quoted(robot)} --environment ${quoted(environment)}`,
    `--formats ${quoted(formats)} --into /srv/maps`,
  ].join(" \\\n  ");
}

/** Quotes for a POSIX shell, if need be. */
export function quoted(text: string): string {
  return /^[\w@%+=:,./-]+$/.test(text) ? text : `'${text.replaceAll("'", `'\\''`)}'`;
}

/** Returns the end of a token: the end of the chosen day, as people mean it. */
export function endOfDay(day: string): string | null {
  if (!day) return null;
  const [year = 0, month = 1, date = 1] = day.split("-").map(Number);
  return new Date(year, month - 1, date, 23, 59, 59).toISOString();
}
