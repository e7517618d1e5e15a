// Our other pages beside the 3-D view, and the take in review in the address. Runs again after each reconnection.
//
// The server writes `<button data-dock="/dataset">`: a click docks that page. It writes, too,
// `<i class="here" data-view="KEY" data-episode="ID">`: by KEY the docked page addresses the 3-D view around it, and
// ID is the take that the bar reviews, so that a reload, or a link, opens it again.
(() => {
  const style = document.getElementById("dock-style") ?? document.head.appendChild(document.createElement("style"));
  style.id = "dock-style";
  style.textContent = DOCK_CSS;
  if (window.studioDock) return;
  window.studioDock = true;

  const SHARE = "studio.dock"; // of the window's width, in the browser's storage
  const SETTLED = 1500; // [ms] after which viser's camera is where the studio wants it
  const NARROWEST = 420; // [px] of the page and of what is left beside it
  const here = () => document.querySelector(".here")?.dataset;

  function open(path, title) {
    close();
    const key = here()?.view;
    const episode = here()?.episode || new URLSearchParams(location.search).get("episode");
    const query = new URLSearchParams({ embed: "1", ...(key && { view: key }), ...(episode && { episode }) });
    const dock = document.createElement("div");
    dock.id = "studio-dock";
    const frame = document.createElement("iframe");
    frame.src = `${path}?${query}`;
    frame.title = title;
    const grip = document.createElement("div");
    grip.className = "grip";
    grip.addEventListener("pointerdown", (event) => resize(event, dock, grip));
    const undock = document.createElement("button");
    undock.className = "undock";
    undock.textContent = "×";
    undock.title = undock.ariaLabel = "Close the page beside the 3-D view";
    undock.addEventListener("click", close);
    dock.append(frame, grip, undock);
    document.body.append(dock);
    document.body.classList.add("docked");
    setWidth(Number(localStorage.getItem(SHARE)) || 0.6);
  }

  function close() {
    const dock = document.getElementById("studio-dock");
    if (!dock) return;
    dock.remove();
    document.body.classList.remove("docked");
    const key = here()?.view;
    if (key) put({ view: key, episode_ids: [] });
    dispatchEvent(new Event("resize"));
  }

  function resize(event, dock, grip) {
    grip.setPointerCapture(event.pointerId);
    dock.classList.add("moving");
    const move = (each) => setWidth(each.clientX / innerWidth);
    grip.addEventListener("pointermove", move);
    grip.addEventListener("pointerup", () => {
      grip.removeEventListener("pointermove", move);
      dock.classList.remove("moving");
    }, { once: true });
  }

  function setWidth(share) {
    const width = Math.min(Math.max(share * innerWidth, NARROWEST), innerWidth - NARROWEST);
    document.documentElement.style.setProperty("--dock", `${Math.round(width)}px`);
    localStorage.setItem(SHARE, width / innerWidth);
    dispatchEvent(new Event("resize"));
  }

  function put(body) {
    return fetch("/api/v1/view", { method: "PUT", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
  }

  let known = {}; // what the mark said last
  setInterval(() => {
    const { view, episode } = here() ?? {};
    if (view === undefined || (view === known.view && episode === known.episode)) return;
    const wanted = new URLSearchParams(location.search).get("episode");
    const isNew = view !== known.view;
    known = { view, episode };
    if (isNew && wanted && !episode) {
      // A review shifts the camera, which must have come to its first place.
      setTimeout(async () => (await put({ view, episode_ids: [wanted], bar: true })).ok || keepInAddress(""), SETTLED);
    } else keepInAddress(episode);
  }, 200);

  function keepInAddress(episode) {
    const address = new URL(location.href);
    if ((address.searchParams.get("episode") ?? "") === episode) return;
    if (episode) address.searchParams.set("episode", episode);
    else address.searchParams.delete("episode");
    history.replaceState(history.state, "", address);
  }

  addEventListener("click", (event) => {
    const button = event.target.closest?.("[data-dock]");
    if (button) open(button.dataset.dock, button.textContent);
  }, true);
})();
