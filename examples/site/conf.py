"""Sphinx's settings for the site that `make docs` builds from the tree that assemble.py lays out."""

from docutils.utils.math.latex2mathml import tex2mathml

import avcli

project = "avcli"
author = "The avcli developers"
version = release = avcli.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = f"avcli {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_search_summary = False  # it would fetch pages, which browsers refuse for files
html_show_sphinx = False
pygments_style = "tango"
autodoc_typehints = "none"
napoleon_google_docstring = True


def setup(app):
    """Formulas become MathML, which browsers draw themselves: no script and no font from the network."""

    def inline(writer, node):
        writer.body.append(tex2mathml(node.astext()))
        raise writer_is_done

    def block(writer, node):
        writer.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
        raise writer_is_done

    from docutils.nodes import SkipNode as writer_is_done

    app.add_html_math_renderer("mathml", (inline, None), (block, None))
