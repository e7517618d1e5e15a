// What the page and the board in the headset both say.

export const MOST_FORCE = 50; // [N] that the servo lets anybody press; the bars end there
export const FOLLOWS = "follows your hand";
export const LOST = { closed: "the session has ended; restart it in the studio", stuck: "the session does not answer" };

export function driver({ is_mine, holder }) {
  return is_mine ? "you drive" : holder ? `${holder} drives` : "nobody drives";
}
