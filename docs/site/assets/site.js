// SPDX-License-Identifier: Apache-2.0
// Draws every equation; one that cannot be drawn is an error in the console, which a test finds.
for (const place of document.querySelectorAll('.arithmatex')) {
  const source = place.textContent.trim();
  try {
    katex.render(source.slice(2, -2), place, { displayMode: source.startsWith('\\[') });
  } catch (error) {
    console.error(`${source}: ${error.message}`);
  }
}
