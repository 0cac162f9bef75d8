/** English. Keys are the same in every language; {names} in braces are replaced. */
export default {
  "patient.title": "Patient screen",
  "patient.breathe_in": "Breathe in",
  "patient.hold": "Hold",
  "patient.breathe_out": "Breathe out",
  "patient.breathe_freely": "Breathe freely",
  "patient.wait": "Please wait",
  "patient.practice": "Practice",
  "pair.hint": "Enter the code that the console shows.",
  "pair.code": "Code, 6 digits",
  "pair.do": "Connect",
  "pair.refused": "Not this code, or it has expired.",
  "pair.locked": "Too many wrong codes. Try again in {seconds} s.",
  "pair.unreachable": "The controller cannot be reached.",
};
