// The page of a painting.
import { start } from "viewer/main";
import { Painting } from "viewer/painting";

start(Painting);
