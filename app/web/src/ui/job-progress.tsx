/** A job under way: how far, what it does, and a button that cancels it. */
import type { Job } from "../api/jobs";
import { Button } from "./button";
import { sentence } from "./states";
import "./job-progress.css";

export function JobProgress({ job, title, onCancel }: { job: Job | null; title: string; onCancel: () => void }) {
  return (
    <div class="job" role="status">
      <span>
        {title}
        <small>{job ? ` ${sentence([job.detail || job.state, job.step].filter(Boolean).join(": "))}` : ""}</small>
      </span>
      <progress aria-label={title} value={job && job.progress > 0 ? job.progress : undefined} />
      <Button onClick={onCancel}>Cancel</Button>
    </div>
  );
}
