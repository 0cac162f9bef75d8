/** German. */
export default {
  "patient.title": "Patientenbildschirm",
  "patient.breathe_in": "Einatmen",
  "patient.hold": "Anhalten",
  "patient.breathe_out": "Ausatmen",
  "patient.breathe_freely": "Ruhig atmen",
  "patient.wait": "Bitte warten",
  "patient.practice": "Übung",
  "pair.hint": "Geben Sie den Code ein, den die Konsole zeigt.",
  "pair.code": "Code, 6 Ziffern",
  "pair.do": "Verbinden",
  "pair.refused": "Nicht dieser Code, oder er ist abgelaufen.",
  "pair.locked": "Zu viele falsche Codes. Wieder in {seconds} s.",
  "pair.unreachable": "Die Steuerung ist nicht erreichbar.",
};
