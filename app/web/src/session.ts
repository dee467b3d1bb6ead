/** The signed-in user. The token stays in an HttpOnly cookie that scripts cannot read. */
import { effect, signal } from "@preact/signals";
import { ApiError, api, asApiError, ask, type Role, returns, type Schemas, unauthenticated } from "./api/client";

export type Session = Schemas["SessionOut"];

const ROLES: Role[] = ["viewer", "mirror", "robot", "editor", "admin"];

/** undefined: not yet asked; null: nobody is signed in. */
export const session = signal<Session | null | undefined>(undefined);

/** Whether a session ended while the page was in use: views stay as they are behind the sign-in dialog. */
export const expired = signal(false);

effect(() => {
  if (unauthenticated.value > 0 && session.peek()) expired.value = true;
});

/** Reads the session at start, or takes the one-time code of the address, which is then removed from it. */
export async function start(): Promise<void> {
  const code = /^#sign-in=([\w-]+)$/.exec(location.hash)?.[1];
  if (code) {
    history.replaceState(null, "", location.pathname + location.search);
    if (await signIn({ code }).catch(() => false)) return;
  }
  try {
    session.value = await ask(api.GET("/api/v1/session"));
  } catch (error) {
    if (!(error instanceof ApiError)) throw error;
    if (error.status === 401) session.value = null;
    else throw error;
  }
}

/** Throws ApiError if the server refuses the token or code. */
export async function signIn(credentials: { token: string } | { code: string }): Promise<boolean> {
  session.value = await ask(api.POST("/api/v1/session", { body: credentials as Schemas["SignInBody"] }));
  expired.value = false;
  returns.value += 1;
  return true;
}

/** Leaves nothing of this user in the page for the next one, and begins anew.
 *
 * Throws if the server cannot end the session: its cookie would sign in whoever comes next. */
export async function signOut(): Promise<void> {
  await ask(api.DELETE("/api/v1/session")).catch((error: unknown) => {
    if (error instanceof ApiError && error.status === 401) return;
    throw new Error(`you are still signed in: ${asApiError(error).message}`);
  });
  session.value = undefined;
  sessionStorage.clear();
  // Over plain HTTP from another host browsers have no caches.
  if ("caches" in window) for (const name of await caches.keys().catch(() => [])) await caches.delete(name);
  location.assign("/");
}

/** Whether the user has at least this role. It decides what is shown; the server decides what is allowed. */
export function can(role: Role): boolean {
  const own = session.value?.role;
  return own !== undefined && ROLES.indexOf(own) >= ROLES.indexOf(role) && (role !== "editor" || own !== "robot");
}
