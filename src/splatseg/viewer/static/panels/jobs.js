/** Long work beside the drawing: how far it is, cancel, what came of it. */

import { byId, el, iconButton, number } from "../dom.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {{row: HTMLElement, bar: HTMLProgressElement, text: HTMLElement, label: string,
 *   done?: (result: any) => void}} Job
 */

export class JobsPanel {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.box = byId("jobs", HTMLElement);
    this.count = 0;
    /** @type {Map<number, Job>} */
    this.jobs = new Map();
    this.box.hidden = true;
  }

  /**
   * @param {string} name
   * @param {Record<string, unknown>} args
   * @param {string} label What it is, for people.
   * @param {(result: any) => void} [done]
   */
  start(name, args, label, done) {
    const id = ++this.count;
    if (!this.app.send({ type: "job", id, name, arguments: args })) return;
    const bar = el("progress", { max: 1, "aria-label": label });
    const text = el("span", { class: "quiet", text: "starting…" });
    const cancel = iconButton(
      "close",
      `Cancel: ${label}`,
      () => {
        this.app.send({ type: "cancel", id });
        text.textContent = "cancelling…";
        cancel.disabled = true;
      },
      { class: "plain" },
    );
    const row = el(
      "div",
      { class: "job" },
      el("div", { class: "job-text" }, el("strong", { text: label }), text),
      cancel,
      bar,
    );
    this.box.append(row);
    this.box.hidden = false;
    this.jobs.set(id, { row, bar, text, label, done });
  }

  /** @param {{id: number, done: number, total: number|null, text: string}} message */
  progress({ id, done, total, text }) {
    const job = this.jobs.get(id);
    if (!job) return;
    if (total) {
      job.bar.max = total;
      job.bar.value = Math.min(done, total);
    } else job.bar.removeAttribute("value");
    const share = total ? `${number(done)} of ${number(total)}` : "";
    job.text.textContent = [text, share].filter(Boolean).join(" · ");
  }

  /** @param {{id: number, result: any}} message */
  finished({ id, result }) {
    const job = this.remove(id);
    if (!job) return;
    const file = result?.file;
    const text = result?.text ? `${job.label}: ${result.text}.` : `${job.label}: done.`;
    if (file) void this.offer(String(file), text);
    else this.app.toasts.show(text, "", { good: true });
    job.done?.(result);
  }

  /** A file to take. @param {string} file @param {string} text */
  async offer(file, text) {
    const path = `/exports/${file.split("/").map(encodeURIComponent).join("/")}`;
    const name = file.split("/").at(-1) ?? file;
    try {
      const href = await this.app.socket.address(path);
      this.app.toasts.show(text, "", { good: true, links: [{ text: name, href, download: name }] });
    } catch {
      this.app.toast(
        `${name} was written, but could not be fetched.`,
        "It lies in the scene's folder exports.",
      );
    }
  }

  /** @param {{id: number, text: string, fix: string|null}} error @returns {boolean} Whether it is one. */
  failed({ id, text, fix }) {
    const job = this.remove(id);
    if (!job) return false;
    if (/^cancel/i.test(text)) this.app.toasts.show(`${job.label}: cancelled.`, "", { good: true });
    else this.app.toast(`${job.label}: ${text}`, fix ?? "");
    return true;
  }

  /** @param {number} id */
  remove(id) {
    const job = this.jobs.get(id);
    job?.row.remove();
    this.jobs.delete(id);
    this.box.hidden = this.jobs.size === 0;
    return job;
  }

  /** The connection was lost: nobody will say how they end. */
  forget() {
    for (const id of [...this.jobs.keys()]) {
      const job = this.remove(id);
      if (job)
        this.app.toast(
          `${job.label}: the connection was lost.`,
          "See whether the file is there, or start it again.",
        );
    }
  }
}
