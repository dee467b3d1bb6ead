/** Work that takes longer than a request: the server answers 202 and a job, which is followed here. */
import { ApiError, request, requestJson, type Schemas } from "./client";

export type Job = Schemas["JobOut"];

const PAUSE = 700;

interface Options {
  signal?: AbortSignal;
  /** Called with the job at each look, and with null when it is over. */
  onJob?: (job: Job | null) => void;
}

/** Fetches a path; if that starts a job, waits for it and fetches again. Aborting cancels the job. Throws ApiError. */
export async function requestWithJob(path: string, { signal, onJob }: Options = {}): Promise<Response> {
  for (;;) {
    const response = await request(path, { signal });
    if (response.status !== 202) return response;
    const address = response.headers.get("location") ?? "";
    try {
      await follow(address, signal, onJob);
    } catch (error) {
      if (signal?.aborted) void request(address, { method: "DELETE" }).catch(() => undefined);
      throw error;
    } finally {
      onJob?.(null);
    }
  }
}

async function follow(address: string, signal?: AbortSignal, onJob?: (job: Job | null) => void): Promise<void> {
  for (;;) {
    const job = await requestJson<Job>(address, { signal });
    if (job.state === "done") return;
    if (job.state === "failed" || job.state === "cancelled") {
      const detail = `the job was ${job.state}: ${job.detail || "try again"}`;
      throw new ApiError(job.problem ?? { type: "about:blank", title: `Job ${job.state}`, status: 409, detail });
    }
    onJob?.(job);
    await pause(signal);
  }
}

function pause(signal?: AbortSignal): Promise<void> {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, PAUSE);
    signal?.addEventListener(
      "abort",
      () => {
        clearTimeout(timer);
        reject(signal.reason);
      },
      { once: true },
    );
  });
}
