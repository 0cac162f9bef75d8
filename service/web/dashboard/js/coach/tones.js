/** Soft tones for new instructions: rising, level, falling. Browsers play none before a click, which the pairing is. */

const GAIN = 0.07;
const LENGTH_S = 0.7;
const EDGE_S = 0.08;
/** Pitch at begin and end [Hz]. */
const PITCHES = { breathe_in: [294, 440], hold: [392, 392], breathe_out: [440, 294] };

export class Tones {
  constructor() {
    this.context = null;
    this.last = "none";
  }

  /** Make sounds possible; call it from a click. */
  unlock() {
    this.context ??= new AudioContext();
    this.context.resume().catch(() => {});
  }

  /** Play the tone of an instruction that is new; say nothing while no guidance is shown. */
  follow(view) {
    const instruction = view.guide?.instruction ?? "none";
    if (instruction === this.last) return;
    this.last = instruction;
    if (view.guide?.sounds === true && instruction in PITCHES && this.context?.state === "running") this.#play(PITCHES[instruction]);
  }

  #play([from, to]) {
    const { context } = this;
    const beginS = context.currentTime;
    const tone = new OscillatorNode(context, { type: "sine", frequency: from });
    const volume = new GainNode(context, { gain: 0 });
    tone.frequency.linearRampToValueAtTime(to, beginS + LENGTH_S);
    volume.gain.linearRampToValueAtTime(GAIN, beginS + EDGE_S);
    volume.gain.setValueAtTime(GAIN, beginS + LENGTH_S - EDGE_S);
    volume.gain.linearRampToValueAtTime(0, beginS + LENGTH_S);
    tone.connect(volume).connect(context.destination);
    tone.start(beginS);
    tone.stop(beginS + LENGTH_S);
  }
}
