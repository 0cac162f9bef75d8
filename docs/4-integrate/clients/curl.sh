#!/usr/bin/env bash
# A whole fraction with curl and jq, against a running service: prepare, learn, reference, arm, deliver, stop, fetch.
#
#   TIDEGATE_URL=http://127.0.0.1:8000 TPS_KEY=tg_... docs/4-integrate/clients/curl.sh PLAN.dcm CALIBRATION.json RECORDING SECONDS FOLDER
#
# TIDEGATE_CA names the site's certificate authority (PEM) where the service speaks TLS. Certificates are always verified.
# Exit code 0: delivered. Anything else: the beam was held and the session stopped, and the last line says why.
set -euo pipefail
plan=$1 calibration=$2 recording=$3 seconds=$4 folder=$5
api="${TIDEGATE_URL:?address of the service}/api/v1"
operator=${OPERATOR:-Simulated therapist}
body=$(mktemp) secrets=$(mktemp)
session=""

# The key goes to curl in a file: arguments can be read by everybody on this machine.
printf 'header = "Authorization: Bearer %s"\n' "${TPS_KEY:?an API key}" >"$secrets"

ask() { # ask METHOD PATH [curl's options]: prints the answer, or the problem and fails
  local method=$1 path=$2
  shift 2
  curl --silent --show-error --fail-with-body --max-time 15 ${TIDEGATE_CA:+--cacert "$TIDEGATE_CA"} \
    --config "$secrets" --request "$method" "$api$path" "$@" >"$body" || {
    echo "$method $path refused: $(jq -r '"\(.status) \(.code): \(.detail)"' "$body" 2>/dev/null || cat "$body")" >&2
    return 1
  }
  cat "$body"
}
json() { ask "$1" "$2" --header 'Content-Type: application/json' "${@:4}" --data "$3"; }
who=$(jq -n --arg operator "$operator" '{operator: $operator}')

# Whatever happens, the beam is held first. Holding may be asked for again and again; arming may not.
leave() {
  status=$?
  trap - EXIT
  if [ -n "$session" ]; then
    for _ in 1 2 3; do json POST "/sessions/$session/hold" "$who" >/dev/null && break; done
    json POST "/sessions/$session/stop" "$who" >/dev/null || true
  fi
  rm -f "$body" "$secrets"
  exit "$status"
}
trap leave EXIT
trap 'exit 130' INT TERM

# Creating is repeatable: the same Idempotency-Key is the same plan, the same calibration, the same session.
once() { echo "Idempotency-Key: $(basename "$folder")-$1"; }
plan_id=$(ask POST /plans --header 'Content-Type: application/dicom' --header "$(once plan)" --data-binary "@$plan" | jq -r .id)
calibration_id=$(ask POST /calibrations --header 'Content-Type: application/json' --header "$(once calibration)" \
  --data-binary "@$calibration" | jq -r .id)
wish=$(jq -n --arg operator "$operator" --arg path "$recording" --arg calibration "$calibration_id" '{
  operator: $operator, fraction_number: 1, calibration_id: $calibration,
  source: {kind: "recording", path: $path, player: "reader"},
  window: {signal: "whole", lower_mm: -1.5, upper_mm: 2.0}}')
session=$(json POST "/plans/$plan_id/sessions" "$wish" --header "$(once session)" | jq -r .id)
json POST "/sessions/$session/start" "$who" >/dev/null
echo "session $session runs"

now() { ask GET "/sessions/$session"; }
until state=$(now); [ "$(jq -r .measurement_state <<<"$state")" = measuring ]; do
  [ "$(jq -r .status <<<"$state")" = running ] || { echo "the session is over: $(jq -r .status_detail <<<"$state")" >&2; exit 1; }
  echo "learning: $(jq -r '.training | "\((.share // 0) * 100 | floor) % \(.note // "")"' <<<"$state")"
  sleep 1
done
# A person at the page sets the reference, and sees where in the breath it is; no key may.
until [ "$(now | jq -r .has_reference)" = true ]; do
  [ "$(now | jq -r .status)" = running ] || exit 1
  echo "waiting for a person to set the reference"
  sleep 1
done

# The window is on the whole region; on a part of the patient the arming needs head_direction, as a person sees it.
# A person who may arm has to be at a visible page of Tidegate.
# Arming is asked for once. Refused (409) means that it was not done: then it may be asked for again, by a decision.
until json POST "/sessions/$session/arm" "$who" >/dev/null; do
  [ "$(now | jq -r .status)" = running ] || exit 1
  sleep 0.5
done
echo "armed: the gate decides"

# Beam-on time, from the live stream: the camera's own clock, between one frame and the next.
delivered() {
  curl --silent --show-error --fail-with-body --no-buffer ${TIDEGATE_CA:+--cacert "$TIDEGATE_CA"} --config "$secrets" \
    "$api/live/events?form=thin" | sed -un 's/^data: //p' |
    jq --unbuffered -rn --arg session "$session" --argjson seconds "$seconds" '
      label $done | foreach (inputs | select(.type == "idle" or (.type == "sample" and .session_id == $session))) as $frame (
        {on: 0, last: null};
        (if .last.line_on and $frame.type == "sample" then .on += ($frame.timestamp_us - .last.timestamp_us) / 1000000 else . end)
          | .last = $frame;
        if .on >= $seconds then "delivered \(.on * 1000 | round / 1000) s", break $done
        elif $frame.gate == "fault" then "fault \($frame.hold_reason): a person has to acknowledge", break $done
        elif $frame.type == "idle" or $frame.session_status != "running" then "the session is over", break $done
        else empty end)' || true
}
outcome=$(delivered)
json POST "/sessions/$session/hold" "$who" >/dev/null
echo "$outcome"
json POST "/sessions/$session/stop" "$who" >/dev/null

# Whole file or nothing: under another name first.
mkdir -p "$folder"
ask GET "/sessions/$session/samples?format=csv" >"$folder/.samples.csv"
mv "$folder/.samples.csv" "$folder/samples.csv"
ask GET "/sessions/$session/transitions?limit=500" >"$folder/transitions.json"
ask GET "/audit/verify" | jq -e .is_intact >/dev/null
session=""
echo "samples: $(($(wc -l <"$folder/samples.csv") - 1)) frames, $(jq '.items | length' "$folder/transitions.json") transitions"
case $outcome in delivered*) ;; *) exit 1 ;; esac
