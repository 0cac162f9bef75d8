/** The last minutes of a session, for a page that was opened in it: the recorded samples since its present zero was set. */

import { readAudit } from "../api.js";

/** What sets another zero: samples before it are not comparable with those after it. */
const ZEROS = ["session.reference", "model.reference_set", "model.zero_needed", "model.activate"];

/**
 * @param {URL} liveUrl of the stream, which resends what is recorded
 * @param {{session_id: string, frame_index: number}} first the first sample that this page has
 * @returns {Promise<object[]>} messages before it, the oldest first; none where they, or the zeros, cannot be read
 */
export async function readHistory(liveUrl, { session_id: id, frame_index: first }) {
  // Each by itself: the transitions of an armed gate are rows too, some hundred in a minute.
  const newest = await Promise.all(ZEROS.map((action) => readAudit({ session_id: id, action, outcome: "done", limit: 1 })));
  const sinceMs = Math.max(-Infinity, ...newest.flatMap(({ items }) => items.map((one) => Date.parse(one.at))));
  const found = (await recorded(liveUrl, id, first)).filter((one) => Date.parse(one.received_at) > sinceMs);
  return found.slice(found.findLastIndex((one) => one.state === "training") + 1);
}

function recorded(liveUrl, id, first) {
  const url = new URL(liveUrl);
  url.search = new URLSearchParams({ session_id: id, after_frame: -1 });
  const found = [];
  return new Promise((resolve) => {
    const socket = new WebSocket(url);
    socket.addEventListener("close", () => resolve(found));
    socket.addEventListener("message", ({ data }) => {
      const message = JSON.parse(data);
      if (message.form === "recorded" && message.frame_index < first) found.push(message);
      else if (message.type !== "hello") socket.close();
    });
  });
}
