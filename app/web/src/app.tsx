import { useEffect, useState } from "preact/hooks";
import { type ApiError, asApiError } from "./api/client";
import { expired, session } from "./session";
import { site } from "./site";
import "./theme";
import { Dialog } from "./ui/dialog";
import { Problem } from "./ui/states";
import { Toasts } from "./ui/toast";
import { SignIn } from "./views/sign-in";
import { SiteView } from "./views/site-view";
import { Sites } from "./views/sites";

export function App({ starting }: { starting: Promise<void> }) {
  const [problem, setProblem] = useState<ApiError | null>(null);
  useEffect(() => {
    starting.catch((error) => setProblem(asApiError(error)));
  }, [starting]);
  if (problem) {
    return (
      <main class="alone">
        <Problem error={problem} retry={() => location.reload()} />
      </main>
    );
  }
  if (session.value === undefined) return <main class="alone" aria-busy="true" />;
  if (session.value === null) return <SignIn />;
  return (
    <>
      {site.value ? <SiteView key={site.value.name} site={site.value} /> : <Sites />}
      <Dialog open={expired.value} title="Sign in again">
        <p>Your session has ended. Nothing on this page is lost: sign in to go on.</p>
        <SignIn inDialog />
      </Dialog>
      <Toasts />
    </>
  );
}
