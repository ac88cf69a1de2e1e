// Shows the teacher's state, and sends orders. The state is requested twice a second.
const $ = (id) => document.getElementById(id);
const buttons = new Map(); // of the classes, by name
let listed = ""; // names of the classes on the page
let shown = ""; // the newest state
let ended = false; // the lesson has ended, and the page says how
let asking = false; // a request is in progress

async function order(text) {
  try {
    const answer = await fetch("order", {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify({ order: text }),
    });
    if (!answer.ok) $("note").textContent = await answer.text();
  } catch {
    $("note").textContent = "The teaching program does not answer.";
  }
  await look();
}

// A button stays in place while its counts change: a press that lasts over a change is not lost.
function button(each, entry, chosen) {
  const made = buttons.get(entry.name) ?? document.createElement("button");
  if (!buttons.has(entry.name)) {
    made.type = "button";
    made.append(entry.name, document.createElement("small"));
    made.addEventListener("click", () => order(entry.name));
    buttons.set(entry.name, made);
  }
  made.setAttribute("aria-pressed", String(chosen));
  made.lastChild.textContent = `${entry.touches} of ${each} touches`
    + (entry.right === null ? "" : `, ${entry.right} told right`);
  return made;
}

function show(state) {
  $("prompt").textContent = state.prompt;
  if (!state.classes) return; // at rest, before the first touch
  $("note").textContent = state.said;
  ended = state.ended;
  const made = state.classes.map((entry) => button(state.each, entry, entry.name === state.label));
  const names = state.classes.map((entry) => entry.name).join("\n");
  if (names !== listed) $("classes").replaceChildren(...made);
  listed = names;
  $("told").textContent = state.of
    ? `${state.right} of ${state.of} touches are right, leave-one-out: judged by all others.`
    : "Two touches of a class are needed first.";
  const lines = state.odd.map(([n, label, like]) => like === label
    ? `Touch ${n} is unlike the others of ${label}.`
    : `Touch ${n} (${label}) is more like ${like}.`);
  lines.push(...state.confused.map(([a, b]) => `${a} is taken for ${b}.`));
  $("odd").replaceChildren(...lines.map((line) => {
    const item = document.createElement("li");
    item.textContent = line;
    return item;
  }));
}

async function look() {
  if (asking) return;
  asking = true;
  try {
    const text = await (await fetch("state")).text();
    if (text !== shown) show(JSON.parse(text));
    shown = text;
  } catch {
    if (!ended) $("prompt").textContent = "The teaching program has ended.";
    shown = "";
  } finally {
    asking = false;
  }
}

$("new").addEventListener("submit", (event) => {
  event.preventDefault();
  if ($("name").value.trim()) order($("name").value.trim());
  $("name").value = "";
});
$("undo").addEventListener("click", () => order("undo"));
$("done").addEventListener("click", () => order("done"));
await look();
setInterval(look, 500);
