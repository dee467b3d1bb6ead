/** Uploads with progress, which `fetch` does not report. */
import { ApiError, asProblem, countRefusal, isSilent, online, returns } from "./client";

interface SendOptions {
  headers?: Record<string, string>;
  signal?: AbortSignal;
  /** Receives the share of the body that has been sent, 0 to 1. */
  onProgress?: (share: number) => void;
}

/** Posts a form and returns the JSON of the response. Throws ApiError, or AbortError after an abort. */
export function sendForm<T>(path: string, form: FormData, { headers, signal, onProgress }: SendOptions = {}) {
  return new Promise<T>((resolve, reject) => {
    const call = new XMLHttpRequest();
    const since = returns.peek();
    const abort = () => call.abort();
    call.open("POST", path);
    call.responseType = "json";
    for (const [name, value] of Object.entries(headers ?? {})) call.setRequestHeader(name, value);
    call.upload.onprogress = ({ loaded, total }) => onProgress?.(total ? loaded / total : 0);
    call.upload.onload = () => onProgress?.(1);
    call.onabort = () => reject(new DOMException("cancelled", "AbortError"));
    const fail = () => {
      online.value = false;
      reject(ApiError.offline());
    };
    call.onerror = fail;
    call.onload = async () => {
      if (await isSilent(call.status, call.getResponseHeader("content-type"))) return fail();
      countRefusal(call.status, since);
      online.value = true;
      if (call.status >= 200 && call.status < 300) resolve(call.response as T);
      else reject(new ApiError(asProblem(call.response, call)));
    };
    call.onloadend = () => signal?.removeEventListener("abort", abort);
    if (signal?.aborted) return reject(new DOMException("cancelled", "AbortError"));
    signal?.addEventListener("abort", abort);
    call.send(form);
  });
}
