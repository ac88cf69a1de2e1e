// Shows what the teacher says, and sends orders. The state is asked for twice a second.
const $ = (id) => document.getElementById(id);

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

function button(each, entry, chosen) {
  const made = document.createElement("button");
  made.type = "button";
  made.setAttribute("aria-pressed", String(chosen));
  made.append(entry.name);
  const small = document.createElement("small");
  small.textContent = `${entry.touches} of ${each} touches`
    + (entry.right === null ? "" : `, ${entry.right} told right`);
  made.append(small);
  made.addEventListener("click", () => order(entry.name));
  return made;
}

function show(state) {
  $("prompt").textContent = state.prompt;
  if (!state.classes) return; // at rest, before the first touch
  $("note").textContent = state.said;
  $("classes").replaceChildren(
    ...state.classes.map((entry) => button(state.each, entry, entry.name === state.label)),
  );
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

let shown = "";
async function look() {
  try {
    const text = await (await fetch("state")).text();
    if (text !== shown) show(JSON.parse(text));
    shown = text;
  } catch {
    shown = "";
    $("prompt").textContent = "The teaching program has ended.";
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
