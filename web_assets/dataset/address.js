// What the address says of the view, and the other way round: a link shows the same again.

const FILTERS = ["task", "operator", "agent", "outcome", "min_quality", "text", "seed"];

// {filters, sort, descending, source, episode, isEmbedded} of the address.
export function read() {
  const given = new URLSearchParams(location.search);
  const filters = {};
  for (const name of FILTERS) if (given.get(name)) filters[name] = given.get(name);
  if (given.getAll("flags").length) filters.flags = given.getAll("flags");
  const collection = given.get("collection");
  return {
    filters,
    sort: given.get("sort") ?? "started",
    descending: given.get("order") !== "asc",
    source: given.has("trash") ? { kind: "trash" } : collection ? { kind: "collection", name: collection } : { kind: "all" },
    episode: given.get("episode"),
    isEmbedded: given.has("embed"),
  };
}

// Write it; `isStep` makes it one to come back to. What else the address says (embed, client) stays.
export function write({ filters, sort, descending, source, episode }, isStep) {
  const told = new URLSearchParams(location.search);
  for (const name of [...FILTERS, "flags", "sort", "order", "trash", "collection", "episode"]) told.delete(name);
  for (const name of FILTERS) if (filters[name]) told.set(name, filters[name]);
  for (const flag of filters.flags ?? []) told.append("flags", flag);
  if (sort !== "started") told.set("sort", sort);
  if (!descending) told.set("order", "asc");
  if (source.kind === "trash") told.set("trash", "1");
  if (source.kind === "collection") told.set("collection", source.name);
  if (episode) told.set("episode", episode);
  const text = told.toString();
  const address = location.pathname + (text && `?${text}`);
  if (address === location.pathname + location.search) return;
  history[isStep ? "pushState" : "replaceState"](null, "", address);
}
